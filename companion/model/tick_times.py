"""Durations of a tick, from its records."""

from __future__ import annotations

from companion.model.outputs import Sent
from companion.model.types import Inputs


class TickTimes:
    """Computes the durations of consecutive ticks. Some end in the next tick, whose joint state reports when currents were written."""

    def __init__(self) -> None:
        self._before: tuple[Inputs, Sent] | None = None
        self._frame_s: float | None = None

    def take(self, inputs: Inputs, sent: Sent) -> dict[str, float]:
        """Return the durations known with the next tick, s, by the fields of `analysis.timing.Timing`, and `mocap_age_s`."""
        sent_s = end_s(sent)
        found = {
            "lateness_s": sent.lateness_s,
            "wait_for_joints_s": sent.joint_read_s - sent.start_s,
            "core_s": sent.core_s - sent.joint_read_s,
            "send_s": sent_s - sent.core_s,
            "whole_s": sent_s - sent.start_s,
        }
        arm, mocap, (earlier, wrote) = inputs.arm, inputs.mocap, self._before or (None, None)
        before = None if earlier is None else earlier.arm
        if arm is not None and arm.asked_s is not None and (before is None or before.stamp_s != arm.stamp_s):
            found["bus_read_s"] = arm.stamp_s - arm.asked_s
        if arm is not None and arm.written_s is not None and before is not None and wrote is not None:
            written = wrote.arm_torque_sent_nm is not None and arm.written_s >= wrote.core_s
            if written and arm.stamp_s > before.stamp_s:
                found["joint_read_to_write_s"] = arm.written_s - before.stamp_s
                if before.asked_s is not None:
                    found["bus_cycle_s"] = arm.written_s - before.asked_s
        if mocap is not None:
            found["mocap_age_s"] = inputs.t_s - mocap.stamp_s + (mocap.latency_s or 0.0)
            if mocap.stamp_s != self._frame_s:
                # The first frame seen may have waited for the loop to begin.
                if self._frame_s is not None and sent.attitude_sent:
                    found["mocap_to_setpoint_s"] = sent.setpoint_sent_s - mocap.stamp_s
                self._frame_s = mocap.stamp_s
        self._before = (inputs, sent)
        return found


def end_s(sent: Sent) -> float:
    """Return the time at which a tick had sent everything: setpoint to PX4 and currents to the bus thread, in either order."""
    return max(sent.setpoint_sent_s, sent.current_sent_s)
