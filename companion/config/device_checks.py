"""What a vehicle file's devices lack, beyond what its models check: plug-ins, and what only hardware needs."""

from __future__ import annotations

from companion.config import device_plugins
from companion.config.base import Location
from companion.config.device_plugins import DYNAMIXEL
from companion.config.devices import ANY_INTERFACE
from companion.config.document import RANK_VALUE, Document, Problem, key_path, problem_lines
from companion.config.vehicle import Vehicle
from companion.plugins import ARMS, FORCE_SENSORS, MOCAP_SYSTEMS


def missing_on_hardware(vehicle: Vehicle, document: Document) -> list[str]:
    """Return messages if motion capture is received from every network, where any sender could use Motive's address, or nothing says
    where the other vehicle of a team is and with which key it signs.
    """
    found: list[tuple[Location, str]] = []
    mocap, link = vehicle.devices.mocap, vehicle.devices.team
    if mocap.interface == ANY_INTERFACE and not mocap.external:
        text = f'expected the address of this computer on the camera network, got "{mocap.interface}" (every network); '
        text += "`ip -4 address` shows it, `companion mocap check` proposes it"
        found.append((("devices", "mocap", "interface"), text))
    if link is not None and link.partner is None:
        text = "missing; expected the IPv4 address of the other vehicle's computer"
        found.append((("devices", "team", "partner"), text))
    if link is not None and link.key_file is None:
        found.append(
            (("devices", "team", "key_file"), "missing; expected the file of the key that both vehicles share")
        )
    return problem_lines(
        [
            Problem(RANK_VALUE, document.origin(at), f"{key_path(at)}: {text}; flights with --sitl do not need it")
            for at, text in found
        ]
    )


def unusable_devices(vehicle: Vehicle, document: Document) -> list[str]:
    """Return messages if a device is of a type that is not installed, or its options are invalid. Logs are read without this check."""
    found: list[tuple[Location, str]] = []
    for name, group, device in (
        ("mocap", MOCAP_SYSTEMS, vehicle.devices.mocap),
        ("force", FORCE_SENSORS, vehicle.devices.force),
        ("arm", ARMS, vehicle.devices.arm),
    ):
        if device is not None:
            problems = device_plugins.problems(group, device.type, device.options)
            found += [(("devices", name, *at), text) for at, text in problems]
    mocap = vehicle.devices.mocap
    if mocap.ball is not None and not found and not device_plugins.sees_markers(mocap.type):
        text = f"the motion-capture system {mocap.type} hands on no markers, so that no ball can be followed; remove it"
        found.append((("devices", "mocap", "ball"), text))
    if vehicle.devices.arm is not None and vehicle.devices.arm.type == DYNAMIXEL:
        text = f"expected the model of the servo, because devices.arm.type is {DYNAMIXEL}, got null"
        joints = enumerate(vehicle.arm.joints)
        found += [(("arm", "joints", index, "servo"), text) for index, joint in joints if joint.servo is None]
    return problem_lines([Problem(RANK_VALUE, document.origin(at), f"{key_path(at)}: {text}") for at, text in found])
