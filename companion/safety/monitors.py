"""All monitors of one flight: pure judges of the inputs. What is found becomes one event when it begins; rules.py says what is done."""

from __future__ import annotations

import dataclasses

from companion.config.vehicle import Vehicle
from companion.model.types import Event, Inputs, OperatorCommand, VehicleState
from companion.safety.findings import Findings, Situation
from companion.safety.finite import FiniteInputs
from companion.safety.monitors_arm import ArmMonitor, ForceMonitor
from companion.safety.monitors_flight import FlightMonitor
from companion.safety.monitors_mocap import MocapMonitor, unfused
from companion.safety.monitors_px4 import Px4Monitor
from companion.safety.rules import (
    GUARDIAN_LOST,
    LOOP_LATE,
    LOOP_STALLED,
    OPERATOR_ABORT,
    OPERATOR_HOLD,
    OPERATOR_LAND,
    OPERATOR_RESUME,
    OPERATOR_START,
    REATTACHED,
    RECORDER_DROPS,
)

__all__ = ["Monitors", "Situation", "unfused"]

AWAKE_STEP_MAX_S = 0.02
"""A tick counts for no more than this in the age of inputs."""
MOVING_M_S, MOVING_RAD_S = 0.03, 0.05
"""Above the noise of a machine that stands: what it measures must change."""
# What is asked for lasts one tick; what lasts longer counts once.
_ASKED = {
    OperatorCommand.HOLD: (OPERATOR_HOLD, "a stop was asked for"),
    OperatorCommand.RESUME: (OPERATOR_RESUME, "going on was asked for"),
    OperatorCommand.START: (OPERATOR_START, "take-off was asked for"),
    OperatorCommand.LAND: (OPERATOR_LAND, "landing was asked for"),
    OperatorCommand.ABORT: (OPERATOR_ABORT, "an abort was asked for"),
}


class Monitors:
    """State is how long each finding has lasted, how old each input is, and what was seen last.

    Args:
        vehicle: limits, walls, room and tether.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self._s = vehicle.safety
        self._findings = Findings(vehicle.safety)
        self._finite = FiniteInputs()
        self._mocap = MocapMonitor(vehicle)
        self._px4 = Px4Monitor(vehicle)
        self._arm = ArmMonitor(vehicle)
        self._force = ForceMonitor(vehicle)
        self._flight = FlightMonitor(vehicle)
        self._awake_s = 0.0
        self._last_t_s: float | None = None
        self._command = OperatorCommand.NONE
        self._airborne = False
        self.trusted: Inputs | None = None
        """The inputs of the last tick without what is not to be believed: the very same object if all of it is."""

    @property
    def mocap_trusted(self) -> bool:
        """Poses may be passed on to PX4. In the air no repeated one, long before that is a finding: PX4 would think that it stands."""
        return self._mocap.trusted and not (self._mocap.repeats and self._airborne)

    @property
    def mocap_innovation_m(self) -> float:
        """Distance between the newest pose and the position predicted by the IMU; 0 while that is not judged."""
        return self._mocap.innovation_m

    def forget(self) -> None:
        """Tell again what is still there: a HOLD was taken back."""
        self._findings.forget()

    def standing(self) -> str | None:
        """In words, what the vehicle must hold for, as of the last tick; None: nothing, or gone for a second."""
        return self._findings.standing()

    def check(self, inputs: Inputs, situation: Situation) -> tuple[Event, ...]:
        """Events that begin in this tick."""
        findings = self._findings
        self._airborne = situation.airborne
        gap_s = inputs.t_s - self._last_t_s if self._last_t_s is not None else 0.0
        self._last_t_s = inputs.t_s
        awake_s = self._awake_s = self._awake_s + min(gap_s, AWAKE_STEP_MAX_S)
        i = self._finite.clean(inputs, findings)
        command = i.command
        if command is not self._command:
            self._command = command
            if command is not OperatorCommand.NONE:
                findings.found(*_ASKED[command])
        if situation.found_armed is not None:
            findings.found(REATTACHED, "{}", situation.found_armed)
        if not situation.waiting:
            moving = i.vehicle is not None and _moves(i.vehicle)
            self._mocap.check(i, situation, awake_s, moving, findings)
            self._px4.check(i, situation, awake_s, moving, findings)
            self._arm.check(i, awake_s, findings)
            self._force.check(i, situation, awake_s, gap_s, moving, findings)
            if gap_s > self._s.loop_late_s:
                rule = LOOP_STALLED if gap_s > self._s.loop_stalled_s else LOOP_LATE
                findings.found(rule, "the control loop was held up for {:.0f} ms", gap_s * 1e3)
            if i.recorder_dropped:
                findings.found(RECORDER_DROPS, "the recorder loses samples")
            if i.guardian_ready is False:
                findings.found(GUARDIAN_LOST, "the guardian is dead, or could not take over")
            if not self._mocap.trusted:
                i = dataclasses.replace(i, mocap=None)
            if situation.airborne:
                self._flight.check(i, situation, gap_s, findings)
            if not self._force.trusted:
                i = dataclasses.replace(i, force=None)
        self.trusted = i
        return findings.events(inputs.t_s, situation.airborne)


def _moves(v: VehicleState) -> bool:
    (x, y, z), (p, q, r) = v.velocity_world_m_s, v.angular_rate_body_rad_s
    return x * x + y * y + z * z > MOVING_M_S * MOVING_M_S or p * p + q * q + r * r > MOVING_RAD_S * MOVING_RAD_S
