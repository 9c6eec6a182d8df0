"""A value that is no number, or no possible one, is no measurement: its record counts as not arrived, and is told by name."""

from __future__ import annotations

import dataclasses

from companion.model.types import ArmState, AutopilotStatus, ForceSample, Inputs, MocapPose, Quat, Vec3, VehicleState
from companion.safety.findings import Findings
from companion.safety.rules import (
    ARM_NOT_FINITE,
    FORCE_NOT_FINITE,
    MOCAP_NOT_FINITE,
    STATUS_NOT_FINITE,
    VEHICLE_NOT_FINITE,
)

ABSURD = 1.0e4
"""No quantity here, in its unit, is ever so large."""
_STAMP_MAX_S = 1.0e9


class FiniteInputs:
    """Takes broken records out of the inputs. A record that was looked at once is not looked at again."""

    def __init__(self) -> None:
        self._vehicle: VehicleState | None = None
        self._status: AutopilotStatus | None = None
        self._mocap: MocapPose | None = None
        self._arm: ArmState | None = None
        self._force: ForceSample | None = None

    def clean(self, i: Inputs, findings: Findings) -> Inputs:
        """The same inputs, broken records replaced by None; the same object if there are none."""
        vehicle, status, mocap, arm, force = i.vehicle, i.status, i.mocap, i.arm, i.force
        bad: dict[str, None] = {}
        if vehicle is not None and vehicle is not self._vehicle:
            if _vehicle_is_sound(vehicle):
                self._vehicle = vehicle
            else:
                findings.found(VEHICLE_NOT_FINITE, "PX4's state is no measurement: {}", vehicle)
                bad["vehicle"] = None
        if mocap is not None and mocap is not self._mocap:
            if _mocap_is_sound(mocap):
                self._mocap = mocap
            else:
                findings.found(MOCAP_NOT_FINITE, "this pose is no measurement: {}", mocap)
                bad["mocap"] = None
        if arm is not None and arm is not self._arm:
            if _arm_is_sound(arm):
                self._arm = arm
            else:
                findings.found(ARM_NOT_FINITE, "this joint state is no measurement: {}", arm)
                bad["arm"] = None
        if force is not None and force is not self._force:
            if _stamp(force.stamp_s) and _sound3(force.force_sensor_n) and _sound3(force.torque_sensor_nm):
                self._force = force
            else:
                findings.found(FORCE_NOT_FINITE, "this force sample is no measurement: {}", force)
                bad["force"] = None
        if status is not None and status is not self._status:
            if _status_is_sound(status):
                self._status = status
            else:
                findings.found(STATUS_NOT_FINITE, "PX4's status is no measurement: {}", status)
                bad["status"] = None
        return dataclasses.replace(i, **bad) if bad else i  # type: ignore[arg-type]


# Chained comparisons: NaN fails them all. Written out: these run in every tick, and a call costs more than the comparisons.


def _stamp(t_s: float) -> bool:
    return -_STAMP_MAX_S < t_s < _STAMP_MAX_S


def _sound3(v: Vec3) -> bool:
    x, y, z = v
    return -ABSURD < x < ABSURD and -ABSURD < y < ABSURD and -ABSURD < z < ABSURD


def _is_rotation(q: Quat) -> bool:
    w, x, y, z = q
    return 0.95 < w * w + x * x + y * y + z * z < 1.05


def _vehicle_is_sound(v: VehicleState) -> bool:
    low, high, old, new, boot_s = -ABSURD, ABSURD, -_STAMP_MAX_S, _STAMP_MAX_S, v.boot_s
    (px, py, pz), (vx, vy, vz), (w, x, y, z) = v.position_world_m, v.velocity_world_m_s, v.attitude_wxyz
    (rx, ry, rz), (fx, fy, fz) = v.angular_rate_body_rad_s, v.specific_force_body_m_s2
    imu_boot_s, (dx, dy, dz) = v.imu_boot_s, v.delta_velocity_body_m_s or (0.0, 0.0, 0.0)
    return (
        (low < px < high and low < py < high and low < pz < high)
        and (low < vx < high and low < vy < high and low < vz < high)
        and 0.95 < w * w + x * x + y * y + z * z < 1.05
        and (low < rx < high and low < ry < high and low < rz < high)
        and (low < fx < high and low < fy < high and low < fz < high)
        and old < v.position_stamp_s < new
        and old < v.attitude_stamp_s < new
        and old < v.imu_stamp_s < new
        and (boot_s is None or old < boot_s < new)
        and (imu_boot_s is None or old < imu_boot_s < new)
        and (old < dx < new and old < dy < new and old < dz < new)
    )


def _mocap_is_sound(m: MocapPose) -> bool:
    return (
        _stamp(m.stamp_s)
        and (m.latency_s is None or _stamp(m.latency_s))
        and (m.exposure_server_s is None or _stamp(m.exposure_server_s))
        # Motive may send anything for a body that it does not see; nobody looks at it then.
        and (not m.tracking_valid or (_sound3(m.position_world_m) and _is_rotation(m.attitude_wxyz)))
    )


def _arm_is_sound(a: ArmState) -> bool:
    low, high = -ABSURD, ABSURD
    (a1, a2), (w1, w2), (t1, t2), (c1, c2) = a.angle_rad, a.velocity_rad_s, a.torque_nm, a.temperature_c
    return (
        -_STAMP_MAX_S < a.stamp_s < _STAMP_MAX_S
        and (low < a1 < high and low < a2 < high)
        and (low < w1 < high and low < w2 < high)
        and (low < t1 < high and low < t2 < high)
        and (low < c1 < high and low < c2 < high)
    )


def _status_is_sound(s: AutopilotStatus) -> bool:
    voltage, remaining = s.battery_voltage_v, s.battery_remaining
    return (
        _stamp(s.heartbeat_stamp_s)
        and (voltage is None or -ABSURD < voltage < ABSURD)
        and (remaining is None or -ABSURD < remaining < ABSURD)
    )
