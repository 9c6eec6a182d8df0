"""Loads the configuration of a flight in the simulated world from its files and the command line."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from companion.config.document import ConfigError, Data, Document
from companion.config.loader import FlightConfig, load_flight
from companion.config.overrides import Override, apply_overrides, parse_overrides
from companion.config.shipped import named_file, names, shipped_file
from companion.config.vehicle import Vehicle
from companion.config.yaml_strict import read_document
from companion.control.trial import try_law
from companion.sitl_config.distributions import Laboratory, check_world, take_ranges
from companion.sitl_config.effects.rotors import repeat_for_rotors
from companion.sitl_config.faults import absent_part
from companion.sitl_config.per_joint import repeat_for_joints
from companion.sitl_config.world import World

WORLDS = names("worlds")
DEFAULT_WORLD = "ideal"
"""The world of a configuration that names none."""
RENAMED = {
    "hand": "handling",
    "hand_t_s": "handling_t_s",
    "hand_taps": "handling_taps",
    "hand_tap_n": "handling_tap_n",
    "arm_hand": "arm_handling",
}
"""Old spellings of keys that are still accepted, and the present ones."""
COMMAND_LINE_WORLD = "lab"
"""The world of a simulated flight or campaign whose command names none."""


class SitlConfig(FlightConfig):
    """A flight's configuration and the true parameters of its simulated world; flight process and core receive only `flight`."""

    world: World = World()
    laboratory: Laboratory = Laboratory()
    """Source of the world; `world` contains the numbers drawn from its ranges."""

    @property
    def flight(self) -> FlightConfig:
        """Return the configuration without the world."""
        return FlightConfig(**{name: getattr(self, name) for name in FlightConfig.model_fields})


def load_sitl(
    mission_path: str | Path,
    vehicle_path: str | Path | None = None,
    controller_law: str | None = None,
    preset: str | None = None,
    overrides: Sequence[str | Override] = (),
    *,
    hardware: bool = False,
    world: str = DEFAULT_WORLD,
    real_px4: bool = False,
) -> SitlConfig:
    """Read all files, apply the overrides, draw the world and check the result.

    The arguments are those of `load_flight`, except that overrides may also set keys of `world.`.

    Args:
        world: name of a built-in world, or path of a file.
        real_px4: whether a real PX4 flies, which may have parameters that the stub does not have.

    Raises:
        ConfigError: the files have problems; the exception has one message per problem.
        PluginError: the control law cannot be used, or failed its trial (`companion.control.trial`).
    """
    lines: list[str] = []
    flight = simulated = None
    try:
        flight = load_flight(mission_path, vehicle_path, controller_law, preset, overrides, hardware=hardware)
    except ConfigError as error:
        lines += error.lines
    try:
        vehicle = flight.vehicle if flight is not None else None
        joints, rotors = (len(vehicle.arm.joints), vehicle.airframe.rotor_layout.count) if vehicle else (0, 0)
        simulated = load_world(overrides, world, joints, rotors, real_px4=real_px4)
    except ConfigError as error:
        lines += [line for line in error.lines if line not in lines]
    if flight is None or simulated is None:
        raise ConfigError(lines)
    try_law(flight.controller, flight.vehicle, tuple(map(math.radians, flight.mission.start.arm_deg)))
    truth, laboratory = simulated
    if lines := list(_faults_of_absent_parts(truth, flight.vehicle)):
        raise ConfigError(lines)
    return SitlConfig(
        **{name: getattr(flight, name) for name in FlightConfig.model_fields}, world=truth, laboratory=laboratory
    )


def _faults_of_absent_parts(world: World, vehicle: Vehicle) -> Iterator[str]:
    """Yield one message for each fault that acts on a part or a servo which the vehicle does not have."""
    servos = len(vehicle.arm.joints)
    for number, fault in enumerate(world.faults):
        if fault.kind.startswith("surface_") and not world.surfaces:
            yield f"world.faults[{number}].kind: {fault.kind} needs world.surfaces, but the world has none; try --world wall"
        key = absent_part(fault.kind, vehicle)
        if key is not None:
            yield (
                f"world.faults[{number}].kind: {fault.kind} needs {key}, which vehicle '{vehicle.name}' does not have; "
                "remove the fault (--set world.faults=[])"
            )
        elif fault.kind.startswith("servo_") and fault.servo > servos:
            yield f"world.faults[{number}].servo: vehicle '{vehicle.name}' has {servos} servos, got servo {fault.servo}"


def load_world(
    overrides: Sequence[str | Override] = (),
    world: str = DEFAULT_WORLD,
    joints: int = 0,
    rotors: int = 0,
    *,
    real_px4: bool = False,
) -> tuple[World, Laboratory]:
    """Return a simulated world, drawn from its seed, and the laboratory from which it was drawn.

    Args:
        overrides: `--set` options; options of other sections are ignored. They override ranges before the draw.
        world: name of a built-in world, or path of a file.
        joints: number of joints of the arm. A list with one value for each joint that is shorter is extended by its last value.
        rotors: number of rotors. A list with one value for each rotor that is shorter starts again from its beginning.
        real_px4: as in `load_sitl`.

    Raises:
        ConfigError: the world has problems; the exception has one message per problem.
    """
    document = _extended(read_document(named_file("worlds", world, "--world")))
    apply_overrides(document, "world", parse_overrides(overrides))
    for old, new in RENAMED.items():
        document.rename((), old, new)
    repeat_for_joints(document, joints)
    repeat_for_rotors(document, rotors)
    ranges = take_ranges(document)
    drawn = check_world(document, ranges, _seed_of(document.data))
    if not real_px4 and (unknown := drawn.unknown_to_the_stub()):
        raise ConfigError(unknown)
    return drawn, Laboratory(name=world, ranges=ranges)


def _extended(document: Document) -> Document:
    """Return the document of a world with the keys of the world that it extends; an invalid name is left to validation."""
    name, own = document.data.get("extends"), document.data
    if name not in WORLDS:
        return document
    base = _extended(read_document(shipped_file("worlds", str(name))))
    return Document(
        document.source,
        base.data | own,
        {at: origin for at, origin in base.values.items() if at and at[0] not in own} | document.values,
        {at: origin for at, origin in base.keys.items() if at and at[0] not in own} | document.keys,
        base.problems + document.problems,
    )


def _seed_of(data: dict[str, Data]) -> int:
    """Return the seed in a world's data; 0 in place of an invalid seed, which validation reports."""
    seed = data.get("seed", World().seed)
    return seed if type(seed) is int and seed >= 0 else 0
