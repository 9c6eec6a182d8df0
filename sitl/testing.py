"""Flights in the fast loop as checks, for the tests of the author of a control law or of a phase."""

from __future__ import annotations

from pathlib import Path

from companion.config.shipped import DEFAULT_MISSION
from companion.mission.check import check_mission
from companion.model.types import Event, Outcome
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.campaigns.flights import fly_to_end


def check_catch(law: str, preset: str | None = None, mission: str | Path = DEFAULT_MISSION) -> None:
    """Fly a catch in the fast loop, in the ideal world, with an installed control law.

    Args:
        preset: one of its presets; None for the default.
        mission: mission file with a catch, or the name of a shipped one.

    Raises:
        AssertionError: the mission cannot be flown, the payload was not caught, or the mission was not completed.
        ConfigError: a configuration file is invalid.
        PluginError: the law cannot be used.
    """
    events = _complete(load_sitl(mission, controller_law=law, preset=preset), law)
    assert any(event.id == "catch" for event in events), f"{law}: no catch was detected: {_shown(events)}"


def check_flight(mission: str | Path, *overrides: str) -> list[Event]:
    """Fly a mission in the fast loop, in the ideal world, and return its events.

    Args:
        mission: mission file, or the name of a shipped one.

    Raises:
        AssertionError: the mission cannot be flown, or was not completed.
        ConfigError: a configuration file is invalid.
    """
    return _complete(load_sitl(mission, overrides=overrides), str(mission))


def _complete(config: SitlConfig, label: str) -> list[Event]:
    problems = check_mission(config.mission, config.vehicle, phase_origins=config.sources.phases)
    assert not problems, f"companion fly refuses this mission: {'; '.join(problems)}"
    flown = fly_to_end(config)
    assert flown.error is None, f"{label}: raises in flight: {flown.error}"
    outputs = flown.result.outputs
    events = [event for output in outputs for event in output.events]
    assert not flown.result.crashed, f"{label}: the vehicle crashed: {_shown(events)}"
    assert outputs[-1].outcome is Outcome.COMPLETED, f"{label}: the mission was not completed: {_shown(events)}"
    return events


def _shown(events: list[Event]) -> str:
    return "; ".join(f"t = {event.t_s:.1f} s: {event.text}" for event in events)
