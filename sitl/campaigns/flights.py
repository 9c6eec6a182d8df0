"""Flies a campaign's flights in the fast loop, converts them to logs and grades them."""

from __future__ import annotations

import dataclasses
import gc
import json
import math
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from companion.analysis import metrics
from companion.analysis.log import Array, FlightLog
from companion.config.loader import FlightConfig
from companion.mission.plan import Plan
from companion.model.outputs import Outputs, Sent
from companion.model.types import Event, Inputs, Outcome, SafetyAction, Severity
from companion.sitl_config.distributions import draw
from companion.sitl_config.loader import SitlConfig
from companion.sitl_config.world import World
from sitl.campaigns.runner import Data
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult

LANDING_S = 70.0
"""Largest time that a whole mission takes in addition to its plan."""


@dataclass(frozen=True, slots=True)
class Flown:
    """A fast flight that has ended, normally or by an exception."""

    config: SitlConfig
    fast: FastFlight | None
    """The flight with its final world; None if an exception ended it."""
    result: FastResult
    error: str | None
    """The exception that ended the flight, if any."""

    @property
    def caught_t_s(self) -> float | None:
        """World time of the true catch; None if the payload was not caught."""
        return None if self.fast is None else self.fast.plant.scene.payload.caught_t_s


def with_world(config: SitlConfig, changes: Data) -> SitlConfig:
    """Return the configuration with some keys of its world changed; a different seed draws a different laboratory.

    Args:
        changes: new values (plain data) by key of the world. A key given here is not drawn at random.
    """
    laboratory = config.laboratory.without(list(changes))
    data = config.world.model_dump(mode="json") | changes
    world = World.model_validate_json(json.dumps(draw(data, laboratory.ranges, data["seed"])))
    return config.model_copy(update={"world": world, "laboratory": laboratory})


def laboratory_of(config: SitlConfig) -> Data:
    """Return a row's entries about the flight's world."""
    return {"world_seed": config.world.seed, "model_error": config.world.model_error}


def limit_s(config: SitlConfig) -> float:
    """Return the world time at which a flight that has not ended is lost."""
    return Plan.build(config.mission, config.vehicle).duration_s + LANDING_S


def fly_to_end(config: SitlConfig, until_mission_s: float = math.inf) -> Flown:
    """Fly at most until mission time `until_mission_s`; an exception is returned in `Flown.error`."""
    gc.collect()  # what is left of the flight before: the collector itself comes to the oldest objects after hundreds of flights only
    try:
        fast = FastFlight(config)
        return Flown(fast.config, fast, fast.run(limit_s(config), until_mission_s), None)
    except Exception as error:
        return Flown(config, None, FastResult(), f"{type(error).__name__}: {error}")


def outcome_of(result: FastResult) -> Outcome:
    """Return the outcome of a flight; the guardian may have ended it."""
    if result.crashed:
        return Outcome.CRASHED
    if result.guardian_landed is not None:
        return Outcome.ABORTED if result.guardian_landed else Outcome.LOST
    ended = result.outputs[-1].outcome if result.outputs else None
    return ended or Outcome.LOST


def mission_s(result: FastResult, t_s: float | None) -> float | None:
    """Convert a time from the flight clock to the mission clock, s; None if it is None or the mission has not begun."""
    begun_s = next((o.t_s - o.mission_t_s for o in result.outputs if o.mission_t_s > 0), None)
    return None if t_s is None or begun_s is None else t_s - begun_s


def row_of(
    config: FlightConfig, result: FastResult, caught_t_s: float | None, error: str | None = None, *, cut: bool = False
) -> tuple[Data, FlightLog]:
    """Return the row of a flight and its log.

    The row has the graded results (see `companion.campaigns.compare.aggregate`), but not the flight's identification. What is before
    and after the catch is the world's truth, in the log as well; only `catch_t_s` is the companion's own event.

    Args:
        caught_t_s: world time of the true catch; None if the payload was not caught.
        error: the exception that ended the flight, if any.
        cut: whether the flight was ended in the air on purpose: it is completed if the supervisor did no more than warn.
    """
    log = log_of(config, _without_catch_events(result), caught_t_s)
    last = result.outputs[-1] if result.outputs else None
    ended = last.outcome if last is not None else None
    if cut and last is not None and ended is None:
        ended = Outcome.COMPLETED if last.action.rank <= SafetyAction.WARN.rank else Outcome.ABORTED
    outcome = Outcome.CRASHED if result.crashed else ended or Outcome.LOST
    completed = outcome is Outcome.COMPLETED
    caught = caught_t_s is not None
    pre, post = metrics.flight_masks(log) if log.inputs else (np.zeros(0, np.bool_), np.zeros(0, np.bool_))
    # A part of the mission that was not flown to its end is not graded.
    nothing = metrics.TrackingRms(None, None, None)
    before = metrics.tracking_rms(log, pre) if completed or caught else nothing
    after = metrics.tracking_rms(log, post) if completed and caught else nothing
    position_n, arm_nm = metrics.impedance_error(log) if completed else (None, None)
    return {
        "outcome": outcome.value,
        "error": error,
        "caught": caught,
        "catch_t_s": mission_s(
            result, next((event.t_s for o in result.outputs for event in o.events if event.id == "catch"), None)
        ),
        "rms": {"pre": dataclasses.asdict(before), "post": dataclasses.asdict(after)},
        "impedance_error": {"position_n": position_n, "arm_nm": arm_nm},
        "final_e_z_m": metrics.final_e_z_m(log) if completed else None,
        "peak_e_p_m": _peak(metrics.position_error_m(log)[pre | post]) if completed else None,
        "torque_activity_nm": torque_activity_nm(log, pre | post) if completed else None,
    }, log


def torque_activity_nm(log: FlightLog, mask: metrics.Mask) -> float | None:
    """Return the RMS change of commanded joint torque (norm over the joints, N m) from tick to tick, over the ticks of `mask`."""
    torque = log.column(lambda i, o, s: o.arm_torque_nm, log.joint_count)
    return metrics.rms_norm(np.diff(torque, axis=0)[mask[1:] & mask[:-1]])


def _peak(rows: Array) -> float | None:
    known = rows[np.isfinite(rows).all(axis=1)]
    return float(np.sqrt((known * known).sum(axis=1)).max()) if len(known) else None


def log_of(config: FlightConfig, result: FastResult, caught_t_s: float | None) -> FlightLog:
    """Return the log of a fast flight, for metrics and plots; the log has no file."""
    outputs = _with_catch(result, caught_t_s)
    return FlightLog(
        path=Path("fast"),
        inputs=tuple(result.inputs),
        outputs=outputs,
        sent=tuple(_sent(i, o) for i, o in zip(result.inputs, outputs, strict=True)),
        metadata={"config": {"json": config.model_dump_json()}},
        closed=True,
    )


def _without_catch_events(result: FastResult) -> FastResult:
    kept = [
        msgspec.structs.replace(output, events=tuple(event for event in output.events if event.id != "catch"))
        for output in result.outputs
    ]
    return dataclasses.replace(result, outputs=kept)


def _with_catch(result: FastResult, caught_t_s: float | None) -> tuple[Outputs, ...]:
    """Return the outputs with a catch event: at the true catch if the core missed it, so that errors before and after stay apart."""
    outputs = list(result.outputs)
    seen = any(event.id == "catch" for output in outputs for event in output.events)
    if caught_t_s is not None and not seen:
        at = next((k for k, output in enumerate(outputs) if output.t_s >= caught_t_s), None)
        if at is not None:
            event = Event(
                t_s=outputs[at].t_s,
                id="catch",
                severity=Severity.INFO,
                action=SafetyAction.NOMINAL,
                text="true catch, not detected",
            )
            outputs[at] = msgspec.structs.replace(outputs[at], events=(*outputs[at].events, event))
    return tuple(outputs)


def _sent(i: Inputs, o: Outputs) -> Sent:
    return Sent(
        tick=i.tick,
        attitude_sent=o.attitude is not None,
        arm_torque_sent_nm=o.arm_torque_nm,
        start_s=i.t_s,
        lateness_s=0.0,
        joint_read_s=i.t_s,
        core_s=i.t_s,
        setpoint_sent_s=i.t_s,
        current_sent_s=i.t_s,
    )
