"""Removes records with a non-finite or out-of-range value: they count as not received, and the `*_not_finite` rules report them.

There is no such rule for the clamp, the bar and the other vehicle, whose drivers reject such values.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import msgspec

from companion.model.listing import listed
from companion.model.team import BarPose, ClampState, PartnerState
from companion.model.types import ArmState, AutopilotStatus, ForceSample, Inputs, MocapPose, Quat, Vec3, VehicleState
from companion.safety.flight_context import Values

OUT_OF_RANGE: Final = 1.0e4
"""Largest permitted value; no valid quantity reaches it in any unit."""
_STAMP_MAX_S: Final = 1.0e9
_NOT_CHECKED: Final = ("marker_error_m", "asked_s", "written_s")


class InputFilter:
    """Removes invalid records from the inputs. Each record is checked once."""

    def __init__(self) -> None:
        self._vehicle: VehicleState | None = None
        self._status: AutopilotStatus | None = None
        self._mocap: MocapPose | None = None
        self._arm: ArmState | None = None
        self._force: ForceSample | None = None
        self._clamp: ClampState | None = None
        self._bar: BarPose | None = None
        self._partner: PartnerState | None = None
        self.invalid: dict[str, Any] = {}
        """Invalid records of this tick, by field of `Inputs`."""

    def clean(self, i: Inputs) -> Inputs:
        """Return the inputs with invalid records replaced by None; the same object if there are none."""
        vehicle, status, mocap, arm, force = i.vehicle, i.status, i.mocap, i.arm, i.force
        invalid: dict[str, Any] = {}
        if vehicle is not None and vehicle is not self._vehicle:
            if _vehicle_is_valid(vehicle):
                self._vehicle = vehicle
            else:
                invalid["vehicle"] = vehicle
        if mocap is not None and mocap is not self._mocap:
            if _mocap_is_valid(mocap):
                self._mocap = mocap
            else:
                invalid["mocap"] = mocap
        if arm is not None and arm is not self._arm:
            if _arm_is_valid(arm):
                self._arm = arm
            else:
                invalid["arm"] = arm
        if force is not None and force is not self._force:
            if _force_is_valid(force):
                self._force = force
            else:
                invalid["force"] = force
        if status is not None and status is not self._status:
            if _status_is_valid(status):
                self._status = status
            else:
                invalid["status"] = status
        clamp, bar, partner = i.clamp, i.bar, i.partner
        if clamp is not None and clamp is not self._clamp:
            if _stamp(clamp.stamp_s) and -OUT_OF_RANGE < clamp.angle_rad < OUT_OF_RANGE:
                self._clamp = clamp
            else:
                invalid["clamp"] = clamp
        if bar is not None and bar is not self._bar:
            if _bar_is_valid(bar):
                self._bar = bar
            else:
                invalid["bar"] = bar
        if partner is not None and partner is not self._partner:
            if _partner_is_valid(partner):
                self._partner = partner
            else:
                invalid["partner"] = partner
        self.invalid = invalid
        return msgspec.structs.replace(i, **dict.fromkeys(invalid)) if invalid else i


def invalid(field: str) -> Callable[[InputFilter, None], Values | None]:
    """Return the predicate that holds if this field of the inputs was invalid."""

    def predicate(f: InputFilter, _: None) -> Values | None:
        return (_fault_of(f.invalid[field]),) if field in f.invalid else None

    return predicate


def _fault_of(record: Any) -> str:
    """Return the name and the value of the first field of an invalid record that is not valid."""
    for name in record.__struct_fields__:
        if name in _NOT_CHECKED:
            continue
        value = getattr(record, name)
        limit = _STAMP_MAX_S if name.endswith("_s") and isinstance(value, float) else OUT_OF_RANGE
        numbers = [one for one in (value if isinstance(value, tuple) else (value,)) if isinstance(one, float)]
        if not all(-limit < one < limit for one in numbers) or (name == "attitude_wxyz" and not _is_rotation(value)):
            return f"{name} = {listed(numbers, '.6g')}"
    return "a field is out of range"


# Chained comparisons: NaN fails them all. They are written out because a call in every tick costs more than the comparisons.


def _stamp(t_s: float) -> bool:
    return -_STAMP_MAX_S < t_s < _STAMP_MAX_S


def _in_range3(v: Vec3) -> bool:
    x, y, z = v
    return -OUT_OF_RANGE < x < OUT_OF_RANGE and -OUT_OF_RANGE < y < OUT_OF_RANGE and -OUT_OF_RANGE < z < OUT_OF_RANGE


def _is_rotation(q: Quat) -> bool:
    w, x, y, z = q
    return 0.95 < w * w + x * x + y * y + z * z < 1.05


def _vehicle_is_valid(v: VehicleState) -> bool:
    low, high, old, new, boot_s = -OUT_OF_RANGE, OUT_OF_RANGE, -_STAMP_MAX_S, _STAMP_MAX_S, v.boot_s
    px, py, pz = v.position_world_m
    vx, vy, vz = v.velocity_world_m_s
    w, x, y, z = v.attitude_wxyz
    rx, ry, rz = v.angular_rate_body_rad_s
    fx, fy, fz = v.specific_force_body_m_s2
    imu_boot_s = v.imu_boot_s
    dx, dy, dz = v.delta_velocity_body_m_s or (0.0, 0.0, 0.0)
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


def _mocap_is_valid(m: MocapPose) -> bool:
    return (
        _stamp(m.stamp_s)
        and (m.latency_s is None or _stamp(m.latency_s))
        and (m.exposure_server_s is None or _stamp(m.exposure_server_s))
        # Motive may send any values for an untracked body; its pose is not used.
        and (not m.tracking_valid or (_in_range3(m.position_world_m) and _is_rotation(m.attitude_wxyz)))
    )


def _bar_is_valid(b: BarPose) -> bool:
    seen = not b.tracking_valid or (_in_range3(b.position_world_m) and _is_rotation(b.attitude_wxyz))
    return _stamp(b.stamp_s) and seen


def _partner_is_valid(p: PartnerState) -> bool:
    times_s = p.stamp_s, p.said.together.plan_s, p.said.together.go_server_s, p.said.server_s
    return all(t_s is None or _stamp(t_s) for t_s in times_s) and _in_range3(p.said.position_world_m)


def _arm_is_valid(a: ArmState) -> bool:
    low, high = -OUT_OF_RANGE, OUT_OF_RANGE
    if not -_STAMP_MAX_S < a.stamp_s < _STAMP_MAX_S:
        return False
    for value in a.angle_rad + a.velocity_rad_s + a.torque_nm + a.temperature_c:  # noqa: SIM110 `all` takes three times as long
        if not low < value < high:
            return False
    return True


def _force_is_valid(f: ForceSample) -> bool:
    return _stamp(f.stamp_s) and _in_range3(f.force_sensor_n) and _in_range3(f.torque_sensor_nm)


def _status_is_valid(s: AutopilotStatus) -> bool:
    voltage, remaining = s.battery_voltage_v, s.battery_remaining
    return (
        _stamp(s.heartbeat_stamp_s)
        and (s.battery_stamp_s is None or _stamp(s.battery_stamp_s))
        and (voltage is None or -OUT_OF_RANGE < voltage < OUT_OF_RANGE)
        and (remaining is None or -OUT_OF_RANGE < remaining < OUT_OF_RANGE)
    )
