"""Runs the core again on a log's inputs and compares every output bit for bit."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from companion import __version__
from companion.analysis.log import TICKS_KEPT, FlightLog, LogError, writer
from companion.model.codec import differences, fingerprint, from_packet, to_packet
from companion.model.outputs import Outputs, Sent
from companion.model.types import Inputs
from companion.plugins import CONTROL_LAWS, KINDS, PHASES, installed

OLDER_FINGERPRINTS = (
    "1e7b00d5cd62de28",  # versions up to 0.2.0: every arm has two joints
    "9b601c4b6d344318",  # before there were contact phases
    "d9237ed1d1bff80d",  # before a law could optimise its gains in flight: `ControlLog.impedance_scale`
    "d2306038621d169b",  # before a tip could slide: `Reference.slide_world_n`, fields of the contact
    "f5ff3bacfaa725ce",  # before a slide corrected the measured force and steered: `unseen_n`, `steer_rad`
    "22c8aa0a4bbe44d5",  # the same records; their schema called fields of the contact required that a log leaves out
    "1210f8bc9eeae0e5",  # before clamp errors, and what members of a team compare: `AutopilotStatus.system_id`, `TeamState.agreed`
)
"""Fingerprints of records that lack only fields that have a default now."""


class Core(Protocol):
    """The part of `companion.core.flight_core.FlightCore` that replay needs."""

    def step(self, inputs: Inputs) -> Outputs:
        """Run one tick."""


@dataclass(frozen=True, slots=True)
class Difference:
    """First field that differs, in the first output that differs."""

    tick: int
    t_s: float
    field: str
    logged: object
    recomputed: object

    def __str__(self) -> str:
        return f"tick {self.tick} (t = {self.t_s:.3f} s): {self.field}: logged {self.logged!r}, recomputed {self.recomputed!r}"


@dataclass(frozen=True, slots=True)
class ReplayResult:
    """Number of compared ticks, and the first difference if there is one."""

    ticks: int
    first_difference: Difference | None


def replay(log: FlightLog, make_core: Callable[[str], Core]) -> ReplayResult:
    """Step a new core through the logged inputs; stop at the first difference.

    Args:
        log: a log that begins at tick 0 and has no gaps.
        make_core: makes the core from the recorded configuration (JSON).

    Raises:
        LogError: the log has no configuration, is empty, lacks ticks, or was recorded by a different version of the companion or of
            the control law.
    """
    config_json = check_replayable(log)
    try:
        core = make_core(config_json)
    except ValueError as error:
        reason = ": ".join([line.strip() for line in str(error).splitlines()[:3]])  # of Pydantic: count, key, problem
        raise LogError(
            f"{log.path}: the recorded configuration is not compatible with this version: {reason}"
        ) from None
    ticks = 0
    for inputs, logged, _ in log.every_tick():
        ticks += 1
        recomputed = from_packet(Outputs, to_packet(core.step(inputs)))  # as in a log, where a float 1 is 1.0
        found = differences(logged, recomputed)
        if found is not None:
            field, old, new = found
            return ReplayResult(
                ticks,
                Difference(tick=inputs.tick, t_s=inputs.t_s, field=field or "outputs", logged=old, recomputed=new),
            )
    return ReplayResult(ticks, None)


def check_replayable(log: FlightLog) -> str:
    """Return the recorded configuration (JSON) of a log that can be replayed.

    Raises:
        LogError: the log cannot be replayed; the text gives the reason.
    """
    about = log.metadata.get("companion", {})
    version = about.get("version_companion")
    if version != __version__:
        found = f"companion {version}" if version else "a companion of unknown version"
        raise LogError(
            f"{log.path}: was recorded by {found}, but this is companion {__version__}; replay it with the version that recorded it"
        )
    if about.get("records") not in (fingerprint(Inputs, Outputs, Sent), *OLDER_FINGERPRINTS):
        raise LogError(
            f"{log.path}: the fields of its records differ from those of this version; it was written by "
            f"{writer(log.metadata)}; replay it with that version"
        )
    _check_plugins(log)
    config_json = log.config_json
    if config_json is None:
        raise LogError(f"{log.path}: has no configuration (metadata record 'config'); it cannot be replayed")
    if not log.inputs:
        raise LogError(f"{log.path}: {log.end_missing or 'has no ticks'}")
    first, missing = log.timing.first_tick, log.missing_ticks()
    if first != 0 or missing:
        what = (
            f"{missing} of {log.timing.last_tick - first + 1} ticks are missing"
            if missing
            else f"the first {first} ticks are missing"
        )
        raise LogError(f"{log.path}: {what} (dropped by the recorder); the core's state cannot be rebuilt")
    return config_json


def _check_plugins(log: FlightLog) -> None:
    """Check that the packages are installed that flew: the law's, and those of the types of phases of others."""
    flight = log.metadata.get("flight", {})
    flew = [(PHASES, key.removeprefix("phase_"), value) for key, value in flight.items() if key.startswith("phase_")]
    if "law_distribution" in flight:  # not in older logs, of one of the companion's own laws
        version = flight.get("law_version", "of unknown version")
        flew.insert(0, (CONTROL_LAWS, flight.get("law", "unknown"), f"{flight['law_distribution']} {version}"))
    for group, name, package in flew:
        plugin = installed(group).get(name)
        here = None if plugin is None else f"{plugin.distribution} {plugin.version}"
        if here != package:
            found = "it is not installed" if here is None else f"{here} is installed"
            raise LogError(
                f"{log.path}: was flown by {KINDS[group]} '{name}' of {package}, but {found}; install that version to replay it"
            )


def flight_core(config_json: str) -> Core:
    """Make the flight core from a recorded configuration."""
    from companion.config.loader import logged_flight
    from companion.core.flight_core import FlightCore

    core: Core = FlightCore(logged_flight(config_json))
    return core


def run(path: Path) -> int:
    """Run `companion replay FILE`: 0 if every output in the log is bit-identical, 1 if not, 2 if the log cannot be replayed."""
    try:
        log = FlightLog.read(path, ticks_max=TICKS_KEPT)
        result = replay(log, flight_core)
    except LogError as error:
        print(error, file=sys.stderr)
        return 2
    end = f"; {log.end_missing}" if log.end_missing is not None else ""
    if result.first_difference is not None:
        print(f"{path}: differs at {result.first_difference}{end}")
        return 1
    print(f"{path}: {result.ticks} ticks replayed, every output bit-identical{end}")
    return 0
