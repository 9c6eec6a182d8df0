"""summary.json: the contract that outside scripts rely on. Every key is always present; an unknown value is None (null)."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from companion.analysis import metrics
from companion.analysis.contact import contact_summary
from companion.analysis.log import FlightLog
from companion.analysis.metrics import TrackingRms, percentiles

STAGES = ("wait_for_joints", "core", "send", "whole", "bus_read", "bus_cycle")
"""Keys of `stages_ms`; the key NAME holds the percentiles of the field `NAME_s` of `companion.analysis.timing.Timing`."""
_NO_RMS = TrackingRms(None, None, None)
_NO_TIMES = percentiles(np.empty(0))


def summarise(
    log: FlightLog | None,
    *,
    outcome: str,
    controller: str,
    preset: str,
    payload_kg: float | None = None,
    recorder: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the summary of one flight.

    Args:
        log: log of the flight; None for a flight that left none.
        outcome: completed, refused, aborted, crashed or lost, as determined by the launcher.
        preset: name of the built-in or user's preset.
        payload_kg: true mass in SITL; None on hardware.
        recorder: the recorder's own report (samples, dropped, error); None to count from the log.

    Returns:
        The content of summary.json. Times `*_t_s` and `catch_t_s` are on the mission clock (0 at the take-off command); an
            event's `t_s` is on the flight clock (as recorded) and comes with `mission_t_s`.
    """
    recorder = recorder or ({} if log is None else {"samples": log.timing.ticks, "dropped": log.missing_ticks()})
    summary: dict[str, Any] = {
        "outcome": outcome,
        "controller": controller,
        "preset": preset,
        "payload_kg": payload_kg,
        "catch_t_s": None,
        "catch_confirmed": None,
        "rms": {"pre": asdict(_NO_RMS), "post": asdict(_NO_RMS)},
        "impedance_error": {"position_n": None, "arm_nm": None},
        "final_e_z_m": None,
        "loop": {"rate_hz": None, "ticks": 0, "missed": 0, "lateness_ms": _NO_TIMES},
        "latency_ms": {"mocap_to_setpoint": _NO_TIMES, "joint_read_to_write": _NO_TIMES},
        "stages_ms": dict.fromkeys(STAGES, _NO_TIMES),
        "recorder": {
            "samples": recorder.get("samples", 0),
            "dropped": recorder.get("dropped", 0),
            "error": recorder.get("error"),
        },
        "events": [],
        "tether": {"min_slack_m": None},
        "contact": None,
        "intercept": None,
        "graded_every": 1,
        "log_end_missing": None if log is None else log.end_missing,
        "world": None,
        "autopilot": None,
        "clock": {"kind": "real" if log is None else log.clock, "pace": None, "speed": None},
    }
    if log is None or not log.inputs:
        return summary
    timing = log.timing
    caught = metrics.catch_index(log)
    pre, post = metrics.flight_masks(log)
    position_n, arm_nm = metrics.impedance_error(log)
    if (observed := metrics.force_observer_error_n(log)) is not None:
        summary["force_observer_error_n"] = {"rms": observed[0], "max": observed[1]}
    summary.update(
        catch_t_s=None if caught is None else log.outputs[caught].mission_t_s,
        catch_confirmed=None if caught is None else metrics.unconfirmed_catch_index(log) is None,
        rms={"pre": asdict(metrics.tracking_rms(log, pre)), "post": asdict(metrics.tracking_rms(log, post))},
        impedance_error={"position_n": position_n, "arm_nm": arm_nm},
        final_e_z_m=metrics.final_e_z_m(log),
        loop={
            "rate_hz": metrics.loop_rate_hz(log),
            "ticks": timing.last_tick - timing.first_tick + 1,
            "missed": metrics.missed_deadlines(log),
            "lateness_ms": percentiles(timing.lateness_s),
        },
        latency_ms={
            "mocap_to_setpoint": percentiles(timing.mocap_to_setpoint_s),
            "joint_read_to_write": percentiles(timing.joint_read_to_write_s),
        },
        stages_ms={stage: percentiles(getattr(timing, f"{stage}_s")) for stage in STAGES},
        events=_events(log),
        tether={"min_slack_m": metrics.min_slack_m(log)},
        contact=contact_summary(log),
        intercept=_chase(log),
        graded_every=log.stride,
    )
    finite: dict[str, Any] = _finite(summary)
    return finite


def _finite(value: Any) -> Any:
    """Return nested data with None for NaN and infinity, as a log with such values gives them."""
    if isinstance(value, dict):
        return {key: _finite(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _chase(log: FlightLog) -> dict[str, Any] | None:
    """Return how the newest plan met a ball; None if none was to be met. The launcher adds the world's `miss_m`."""
    chase = next((outputs.chase for outputs in reversed(log.outputs) if outputs.chase is not None), None)
    if chase is None:
        return None
    return {
        "predicted_s": chase.predicted_s,
        "replans": chase.replans,
        "miss_m": None,
        "relative_speed_m_s": chase.relative_speed_m_s,
    }


def effective_config(log: FlightLog, summary: dict[str, Any]) -> dict[str, Any]:
    """Return the logged configuration, plus the simulated world's if the summary has one; empty without a configuration."""
    world = summary.get("world")
    if not log.config or not world:
        return log.config
    # The drawn values are in the configuration, too; the contact is what happened.
    return {**log.config, "world": {key: value for key, value in world.items() if key not in ("drawn", "contact")}}


def world_text(world: dict[str, Any] | None) -> str:
    """Return the name, seed and model error of a simulated world on one line; empty for a flight on hardware.

    Args:
        world: world of a summary or of an effective configuration; those of older versions have no name.
    """
    if not world:
        return ""
    parts = [f"world {world['name']}" if "name" in world else "", f"seed {world.get('seed', '–')}"]
    if world.get("model_error"):
        parts.append(f"model error {world['model_error']:.0%}")
    return ", ".join(part for part in parts if part)


def write_summary(summary: dict[str, Any], path: Path) -> None:
    """Write the summary as JSON.

    Raises:
        OSError: the file cannot be written.
        ValueError: a value is NaN or infinite.
    """
    path.write_text(json.dumps(summary, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _events(log: FlightLog) -> list[dict[str, Any]]:
    return [
        {
            "t_s": event.t_s,
            "mission_t_s": outputs.mission_time_s(event),
            "id": event.id,
            "severity": event.severity.value,
            "action": event.action.value,
            "text": event.text,
        }
        for outputs in log.outputs
        for event in outputs.events
    ]
