"""Loads the configuration of a flight in the simulated world from its files and the command line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from companion.config.document import ConfigError, Document
from companion.config.loader import FlightConfig, check_document, load_flight
from companion.config.overrides import parse_overrides
from companion.sitl_config.world import World

WORLD_DIRECTORY = Path(__file__).parent / "worlds"
"""Built-in worlds are package data, so that they are found wherever the package is installed."""


class SitlConfig(FlightConfig):
    """A flight's configuration and the truth of its simulated world. The flight process and the core are given `flight`."""

    world: World = World()

    @property
    def flight(self) -> FlightConfig:
        """Return the configuration without the world."""
        return FlightConfig(**{name: getattr(self, name) for name in FlightConfig.model_fields})


def load_sitl(
    mission_path: str | Path,
    vehicle_path: str | Path | None = None,
    controller_law: str | None = None,
    preset: str | None = None,
    overrides: Sequence[str] = (),
    *,
    hardware: bool = False,
) -> SitlConfig:
    """Read, override and check everything; arguments as for `load_flight`, with overrides of `world.` as well.

    Raises:
        ConfigError: one message per problem of all files and of the world.
    """
    lines: list[str] = []
    flight = world = None
    try:
        flight = load_flight(mission_path, vehicle_path, controller_law, preset, overrides, hardware=hardware)
    except ConfigError as error:
        lines += error.lines
    try:
        world = load_world(overrides)
    except ConfigError as error:
        lines += [line for line in error.lines if line not in lines]
    if flight is None or world is None:
        raise ConfigError(lines)
    return SitlConfig(**{name: getattr(flight, name) for name in FlightConfig.model_fields}, world=world)


def load_world(overrides: Sequence[str] = ()) -> World:
    """Return the simulated world of the `world.` overrides; there is no file of it.

    Raises:
        ConfigError: one message per problem.
    """
    lines: list[str] = []
    world = check_document(World, Document("world", {}), "world", parse_overrides(overrides), lines)
    if world is None:
        raise ConfigError(lines)
    return world
