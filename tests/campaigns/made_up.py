"""Campaigns without a process of their own, whose flights are made up or flown here."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

from companion.campaigns.process import CampaignError, Message
from companion.campaigns.runner import Campaign, Row
from companion.sitl_config.loader import SitlConfig
from sitl.campaigns.__main__ import _CAMPAIGNS
from sitl.campaigns.runner import fly_all


class Flights:
    """The results of flights that no other process flies, and an error after them."""

    def __init__(self, messages: Iterable[Message], error: CampaignError | None = None) -> None:
        self._messages, self._error = messages, error

    def results(self) -> Iterator[Message]:
        yield from self._messages
        if self._error is not None:
            raise self._error

    def ask_to_stop(self) -> None: ...


def fly_made_up(
    monkeypatch: pytest.MonkeyPatch, row_of: Callable[[dict[str, Any]], Row | None], error: CampaignError | None = None
) -> None:
    """Let `row_of` make the row of each flight of a job, or None for one that is not flown."""

    def start(campaign: Campaign, out: Path) -> contextlib.AbstractContextManager[Flights]:
        made = [(index, row_of(flight)) for index, flight in enumerate(campaign.job()["flights"])]
        messages = [
            {"index": index, "row": row, "wall_s": 0.1, "cpu_s": 0.5 + index % 2, "at_once": 4}
            for index, row in made
            if row is not None
        ]
        return contextlib.nullcontext(Flights(messages[::-1], error))

    monkeypatch.setattr(Campaign, "start", start)


def fly_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the flights of a campaign be flown in this process: the start of its own takes longer than a flight."""

    def start(campaign: Campaign, out: Path) -> contextlib.AbstractContextManager[Flights]:
        job = json.loads(json.dumps(campaign.job()))
        prepare, fly = _CAMPAIGNS[job["campaign"]]
        configs = [SitlConfig.model_validate_json(json.dumps(config)) for config in job["configs"]]
        flown = fly_all(fly, configs, prepare(job, configs), 1, None)
        return contextlib.nullcontext(Flights(json.loads(json.dumps(each, allow_nan=False)) for each in flown))

    monkeypatch.setattr(Campaign, "start", start)


def compare_row(flight: dict[str, Any], e_p_m: float | None = 0.1, **changes: Any) -> Row:
    """The row of a flight of a comparison; e_p_m None: it crashed after the catch."""
    ended = e_p_m is None
    post = {"e_p_m": e_p_m, "e_q_deg": None if ended else 3.0, "e_alpha_deg": None if ended else 2.0}
    return {
        **{key: flight[key] for key in ("controller", "preset", "payload_kg", "seed")},
        "world_seed": flight["seed"],
        "model_error": flight.get("model_error", 0.0),
        "outcome": "crashed" if ended else "completed",
        "error": None,
        "caught": True,
        "catch_t_s": 6.5,
        "rms": {"pre": {"e_p_m": 0.01, "e_q_deg": 1.0, "e_alpha_deg": 1.0}, "post": post},
        "impedance_error": {"position_n": None if ended else 1.0, "arm_nm": None if ended else 0.1},
        "final_e_z_m": None if ended else (-0.02 if flight["seed"] % 2 else 0.01),
        "peak_e_p_m": None if ended else 0.1,
        "torque_activity_nm": None if ended else 0.03,
        **changes,
    }


WORLD: dict[str, Any] = {
    "payload_kg": 0.38,
    "throw_velocity_m_s": [3.5, 0.4, -1.2],
    "catch_at_m": [0.1, 0.0],
    "hover_thrust_error": 0.01,
    "link_mass_error": [0.1, -0.05],
    "setpoint_delay_s": 0.055,
    "arm_delay_s": 0.003,
    "rotor_lag_s": 0.03,
    "wind_m_s": [0.3, -0.4, 0.0],
    "seed": 12,
    "faults": [{"kind": "force_loss", "t_s": 7.25}],
}
"""A drawn world."""


def draw_row(number: int, e_p_m: float | None, outcome: str = "completed", caught: bool = True, **world: Any) -> Row:
    """The row of a draw: `WORLD` with changes."""
    return {
        "name": f"draw {number}", "number": number, "world": {**WORLD, **world}, "world_seed": 12, "model_error": 0.0,
        "outcome": outcome, "why": None, "error": None,
        "thrown": True, "caught": caught, "felt": caught, "caught_s": 6.5 if caught else None, "e_p_m": e_p_m,
        "catch_t_s": 6.5 if caught else None, "events": ["takeoff", "touchdown"],
    }  # fmt: skip


def fault_row(flight: dict[str, Any], **changes: Any) -> Row:
    """The row of a flight with a fault that landed."""
    return {
        "fault": flight["kind"], "phase": flight["phase"], "size": flight["size"], "unit": "s", "duration_s": flight["duration_s"],
        "outcome": "landed", "detected_s": 0.12, "event": "mocap_lost", "reacted_s": 0.12, "action": "autopilot_land",
        "worst_tilt_deg": 5.7, "min_height_m": 1.0, "min_slack_m": 1.2, "drift_m": 0.25, "contact_n": None, "caught": True,
        "problems": [], "events": ["mocap_lost"], "error": None, **changes,
    }  # fmt: skip
