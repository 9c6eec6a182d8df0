"""The parts of a flight log that the identification uses, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from companion.analysis.log import TICKS_KEPT, Array, FlightLog, LogError
from companion.analysis.metrics import catch_index
from companion.commissioning.identify.response import STEP_S
from companion.config.vehicle import Vehicle
from companion.control.hover_thrust import AIRBORNE_M
from companion.model.frames import euler_zyx_from_quat
from companion.model.outputs import Outputs, Sent
from companion.model.types import Inputs, Outcome, PhaseKind

FLIGHT_MIN_S = 8.0
"""Shortest flight in the air from which anything can be found."""
PIECE_MIN_S = 2.0
_BEFORE_CATCH_S, _AFTER_CATCH_S = 0.1, 1.5
"""Time around the catch that is left out: impact and swinging."""
_GAP_MAX_S = 0.03
"""Longest gap between ticks that is interpolated."""


Row = tuple[Inputs, Outputs, Sent]


def read_part(path: Path) -> tuple[FlightLog, range | None]:
    """Read a log. Of a long one, `TICKS_KEPT` ticks are kept, around the catch or from the takeoff on, and their numbers returned.

    Raises:
        LogError: see `FlightLog.read`.
    """
    log = FlightLog.read(path, ticks_max=TICKS_KEPT)
    if log.stride == 1:
        return log, None
    caught = catch_index(log)
    flown = next((i.tick for i, o, _ in log.rows() if o.phase_kind is not PhaseKind.GROUND), log.inputs[0].tick)
    around = flown if caught is None else log.inputs[caught].tick - TICKS_KEPT // 2
    begin = max(flown, min(around, log.inputs[-1].tick + 1 - TICKS_KEPT))
    del log  # its memory is needed
    part = range(begin, begin + TICKS_KEPT)
    return FlightLog.read(path, part=part), part


@dataclass(frozen=True)
class Flight:
    """A flight that is long enough to identify parameters from it."""

    log: FlightLog
    vehicle: Vehicle
    airborne: tuple[tuple[int, int], ...]
    """First and last tick (exclusive) of each uninterrupted part in which only the rotors carry the vehicle and the companion controls
    it, without the impact of a catch and without contact.
    """
    catch: int | None
    """Tick of the catch; None if nothing was caught."""

    @staticmethod
    def of(log: FlightLog) -> Flight:
        """Return the flight of a log.

        Raises:
            LogError: the log has no configuration, or no flight that ended regularly and was long enough.
        """
        vehicle = log.flight_config().vehicle
        outcome = log.outcome
        if log.inputs and outcome is None:
            raise LogError(f"{log.path}: {log.end_missing}; expected a flight that ended with a landing")
        parts = _airborne(log, vehicle)
        if not parts and not any(o.phase_kind is PhaseKind.FLIGHT for o in log.outputs):
            raise LogError(f"{log.path}: the vehicle did not fly; expected the log of a flight")
        if outcome in (Outcome.REFUSED, Outcome.CRASHED, Outcome.LOST):
            raise LogError(f"{log.path}: the flight ended as {outcome.value}; expected one that ended with a landing")
        log_s = sum(end - begin for begin, end in parts) * STEP_S
        if log_s < FLIGHT_MIN_S:
            raise LogError(
                f"{log.path}: too short: {log_s:.1f} s in the air under the companion's control, expected {FLIGHT_MIN_S:g} s or more"
            )
        return Flight(log, vehicle, parts, catch_index(log) if vehicle.has_net else None)

    @property
    def vehicle_file(self) -> Path | None:
        """The vehicle file's path as it was flown, or None if the log does not name it."""
        named = (self.log.config.get("sources") or {}).get("vehicle")
        return Path(named) if named else None

    def rows(self, begin: int, end: int) -> Sequence[Row]:
        """Return the ticks of a part."""
        log = self.log
        return list(zip(log.inputs[begin:end], log.outputs[begin:end], log.sent[begin:end], strict=True))

    @cached_property
    def t_s(self) -> Array:
        """Flight clock of each tick."""
        return self.log.columns.t_s

    @cached_property
    def attitude_setpoint_rad(self) -> Array:
        """Roll, pitch, yaw of the setpoint that each tick sent."""
        return self.log.column(lambda i, o, s: euler_zyx_from_quat(o.attitude.attitude_wxyz) if o.attitude else None, 3)

    @cached_property
    def thrust(self) -> Array:
        """Normalised thrust that each tick sent."""
        return self.log.column(lambda i, o, s: o.attitude.thrust if o.attitude else None)

    @cached_property
    def attitude_rad(self) -> Array:
        """Roll, pitch, yaw of PX4's estimate."""
        return self.log.column(lambda i, o, s: euler_zyx_from_quat(i.vehicle.attitude_wxyz) if i.vehicle else None, 3)

    @cached_property
    def attitude_stamp_s(self) -> Array:
        """Arrival of that estimate."""
        return self.log.column(lambda i, o, s: i.vehicle.attitude_stamp_s if i.vehicle else None)

    @cached_property
    def delta_velocity_m_s(self) -> Array:
        """Integral of the specific force in the body frame up to each tick."""
        total = self.log.column(lambda i, o, s: i.vehicle.delta_velocity_body_m_s if i.vehicle else None, 3)
        stamp_s = self.log.column(lambda i, o, s: i.vehicle.imu_boot_s if i.vehicle else None)
        known = np.isfinite(stamp_s) & np.isfinite(total).all(axis=1)
        if not known.all() and not known[np.isfinite(self.attitude_stamp_s)].all():
            force = self.log.column(lambda i, o, s: i.vehicle.specific_force_body_m_s2 if i.vehicle else None, 3)
            return np.cumsum(np.nan_to_num(force) * np.gradient(self.t_s)[:, None], axis=0)
        offset_s = np.median((self.t_s - stamp_s)[known])
        return np.stack(
            [np.interp(self.t_s, stamp_s[known] + offset_s, total[known, axis]) for axis in range(3)], axis=1
        )

    def grid(self, begin: int, end: int) -> Array:
        """Return the times of a uniform grid over a part, s."""
        return np.arange(self.t_s[begin] + 4.0 * STEP_S, self.t_s[end - 1] - 4.0 * STEP_S, STEP_S)

    def on_grid(self, grid_s: Array, stamps_s: Array, values: Array) -> Array:
        """Return values, one per tick, interpolated on a grid."""
        known = np.isfinite(stamps_s) & np.isfinite(values)
        return np.interp(grid_s, stamps_s[known], values[known])


def _airborne(log: FlightLog, vehicle: Vehicle) -> tuple[tuple[int, int], ...]:
    floor_m = vehicle.airframe.ground_clearance_m + AIRBORNE_M
    caught = catch_index(log) if vehicle.has_net else None
    caught_s = log.inputs[caught].t_s if caught is not None else None
    parts: list[tuple[int, int]] = []
    begin: int | None = None
    before_s: float | None = None
    for tick, (i, o, _) in enumerate(log.rows()):
        flown = (
            o.attitude is not None
            and i.vehicle is not None
            and o.contact is None
            and o.phase_kind in (PhaseKind.TAKEOFF, PhaseKind.FLIGHT, PhaseKind.LANDING)
            and i.vehicle.position_world_m[2] > floor_m
            and not (caught_s is not None and -_BEFORE_CATCH_S < i.t_s - caught_s < _AFTER_CATCH_S)
        )
        gap = before_s is not None and i.t_s - before_s > _GAP_MAX_S
        before_s = i.t_s
        if begin is not None and (gap or not flown):
            parts.append((begin, tick))
            begin = None
        if flown and begin is None:
            begin = tick
    if begin is not None:
        parts.append((begin, len(log.inputs)))
    return tuple((a, b) for a, b in parts if log.inputs[b - 1].t_s - log.inputs[a].t_s >= PIECE_MIN_S)
