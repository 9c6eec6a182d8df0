"""The addresses of the simulated devices, in the form of a vehicle file's `devices` settings."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from companion.config.device_plugins import DYNAMIXEL, NATNET, RFT60
from companion.config.devices import Devices
from sitl.force_torque import ForceTorqueServer
from sitl.natnet import NatNetServer
from sitl.servo.bus import ServoBus

Settings = dict[str, dict[str, Any]]


def settings_of(
    device: Devices,
    mocap: NatNetServer | None,
    mocap_rate_hz: float,
    multicast: bool,
    arm: ServoBus | None,
    force: ForceTorqueServer | None,
) -> Settings:
    """Return the settings with which the companion finds the simulated devices, by device.

    Args:
        device: section `devices` of the vehicle file; a device of another type is replaced.
        mocap: the NatNet server, or None if another program feeds PX4 with poses.
    """
    found: Settings = {}
    if mocap is not None:
        found["mocap"] = {
            "server": "127.0.0.1",
            "interface": "127.0.0.1",
            "transport": "multicast" if multicast else "unicast",
            "command_port": mocap.command_port,
            "up_axis": "z",
            "rate_hz": mocap_rate_hz,
        }
        if device.mocap.type != NATNET:
            found["mocap"] |= {"type": NATNET, "options": {}}
        if multicast:
            found["mocap"]["data_port"] = mocap.data_port
    if arm is not None:
        found["arm"] = {"port": arm.path}
        if device.arm is not None and device.arm.type != DYNAMIXEL:
            found["arm"] |= {"type": DYNAMIXEL, "options": {}}
    if force is not None:
        found["force"] = {"port": force.port}
        if device.force is not None and device.force.type != RFT60:
            found["force"] |= {"type": RFT60, "options": {}, "rate_hz": force.rate_hz}
    return found


def replaced(device: Devices, settings: Settings) -> Iterator[str]:
    """Yield a message about each device whose type the settings replace."""
    for name in ("mocap", "arm", "force"):
        if "type" in settings.get(name, ()):
            ours, theirs = settings[name]["type"], getattr(device, name).type
            yield f"devices.{name}.type: the simulated world has a {ours}, which is used in place of {theirs}"
