"""Attitude and rate cascade with mixer of the PX4 stub (mc_att_control, mc_rate_control, control allocation)."""

from __future__ import annotations

from sitl.autopilot.types import AttitudeTarget, Estimate, RotorCommands


class Cascade:
    """PX4's multicopter attitude P loop, rate PID loop and quad-x mixer."""

    def step(self, dt_s: float, estimate: Estimate, target: AttitudeTarget) -> RotorCommands:
        """One control period."""
        raise NotImplementedError

    def reset(self) -> None:
        """Forget integrators (on arming)."""
        raise NotImplementedError
