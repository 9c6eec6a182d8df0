"""The flight that a control law must complete, as a check for the tests of the law's author."""

from __future__ import annotations

from pathlib import Path

from companion.config.shipped import DEFAULT_MISSION
from companion.mission.check import check_mission
from companion.model.types import Outcome
from companion.sitl_config.loader import load_sitl
from sitl.campaigns.flights import fly_to_end


def check_catch(law: str, preset: str | None = None, mission: str | Path = DEFAULT_MISSION) -> None:
    """Fly a catch in the fast loop, in the ideal world, with an installed control law.

    Args:
        law: name of the law.
        preset: one of its presets; None for the default.
        mission: mission file with a catch, or the name of a shipped one.

    Raises:
        AssertionError: the mission cannot be flown, the payload was not caught, or the mission was not completed.
        ConfigError: a configuration file is invalid.
        PluginError: the law cannot be used.
    """
    config = load_sitl(mission, controller_law=law, preset=preset)
    problems = check_mission(config.mission, config.vehicle, phase_origins=config.sources.phases)
    assert not problems, f"companion fly refuses this mission: {'; '.join(problems)}"
    flown = fly_to_end(config)
    assert flown.error is None, f"{law}: the law raises in flight: {flown.error}"
    outputs = flown.result.outputs
    events = [event for output in outputs for event in output.events]
    text = "; ".join(f"t = {event.t_s:.1f} s: {event.text}" for event in events)
    assert any(event.id == "catch" for event in events), f"{law}: no catch was detected: {text}"
    assert not flown.result.crashed, f"{law}: the vehicle crashed: {text}"
    assert outputs[-1].outcome is Outcome.COMPLETED, f"{law}: the mission was not completed: {text}"
