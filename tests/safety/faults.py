"""Every rule's fault: how its finding is made on a machine in good health, and what else is found with it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import msgspec

from companion.config.loader import load_vehicle
from companion.config.vehicle import Vehicle
from companion.model.frames import quat_from_euler_zyx, quat_multiply
from companion.model.outputs import ControlLog
from companion.model.team import BarPose, ClampState, Grip
from companion.model.types import FlightMode, Inputs, OperatorCommand
from companion.safety.flight_context import FlightContext
from companion.safety.rule import Rule, Subject
from companion.safety.rules import RULES
from tests.safety.healthy import (
    SLOW,
    START_S,
    TICK_S,
    ZERO8,
    Change,
    after_a_moment,
    control,
    fed_by_another,
    flying,
    healthy,
    put,
    stopped,
    with_partner,
)

VEHICLE = load_vehicle("configs/vehicles/tarot650_2r.yaml")


EXTERNAL = load_vehicle("configs/vehicles/tarot650_2r.yaml", overrides=["vehicle.devices.mocap.type=external"])


MEMBER = load_vehicle("configs/vehicles/tarot650_2r.yaml", overrides=["vehicle.devices.team.port=14700"])
"""One of a team of two."""


NO_INERTIAL = load_vehicle(
    "configs/vehicles/tarot650_2r.yaml",
    overrides=["vehicle.safety.mocap_inertial_m=9", "vehicle.safety.mocap_jump_m=1"],
)
"""For positions that move although the IMU rests."""


replace = msgspec.structs.replace


NAN = math.nan


RULE = {rule.id: rule for rule in RULES}


def tethered(**fields: object) -> FlightContext:
    return flying(tether=replace(SLOW, **fields))


def moved(part: str, by_m: tuple[float, float, float]) -> Change:
    def change(i: Inputs) -> Inputs:
        x, y, z = getattr(i, part).position_world_m
        return put(part, position_world_m=(x + by_m[0], y + by_m[1], z + by_m[2]))(i)

    return change


def turned(part: str, by_deg: float) -> Change:
    turn = quat_from_euler_zyx(0.0, 0.0, math.radians(by_deg))
    return lambda i: put(part, attitude_wxyz=quat_multiply(turn, getattr(i, part).attitude_wxyz))(i)


def leaning(by_deg: float) -> Change:
    lean = quat_from_euler_zyx(math.radians(by_deg), 0.0, 0.0)
    return lambda i: put("vehicle", attitude_wxyz=lean)(put("mocap", attitude_wxyz=lean)(i))


def both(*changes: Change) -> Change:
    def change(i: Inputs) -> Inputs:
        for one in changes:
            i = one(i)
        return i

    return change


def drifting(i: Inputs) -> Inputs:
    """PX4's estimate slides away from where the vehicle is, by 0.2 m/s."""
    return moved("vehicle", (0.2 * (i.t_s - START_S), 0.0, 0.0))(i)


def turning(i: Inputs) -> Inputs:
    return turned("vehicle", 10.0 * (i.t_s - START_S))(i)


def frozen_values(part: str, *names: str) -> Change:
    """Values stay, stamps and frame numbers go on."""
    first = getattr(healthy(), part)
    return put(part, **{name: getattr(first, name) for name in names})


def at(x: float, y: float, z: float, vx: float = 0.05, vy: float = 0.0, vz: float = 0.0) -> Change:
    """Somewhere else from the start on; PX4 and motion capture agree."""
    p = (x, y, z)

    def change(i: Inputs) -> Inputs:
        d = 1e-4 * (i.tick % 7)
        here = (p[0] + d, p[1], p[2])
        vehicle = put("vehicle", position_world_m=here, velocity_world_m_s=(vx, vy, vz))
        return put("mocap", position_world_m=here)(vehicle(i))

    return change


FOUND = "PX4 is armed (height 1.00 m, mode OFFBOARD), but not by the companion"


@dataclass(frozen=True)
class Fault:
    """How a rule's finding is made, and what else is found with it."""

    change: Change = lambda i: i
    context: Callable[[], FlightContext] = flying
    sound: int = 3
    """Healthy ticks before it."""
    also: frozenset[str] = field(default_factory=frozenset)


def every_35_ms(i: Inputs) -> Inputs:
    """30 poses in a second."""
    k = i.tick - i.tick % 7
    return replace(i, mocap=healthy(k).mocap)


def slow_link(i: Inputs) -> Inputs:
    """From one tick to the next, what arrives was said 100 ms ago."""
    assert i.vehicle is not None and i.vehicle.boot_s is not None
    return put("vehicle", boot_s=i.vehicle.boot_s - 0.1)(i)


def jumping(i: Inputs) -> Inputs:
    return moved("mocap", (0.4, 0.0, 0.0))(i) if i.tick == 100 else i


def two_streams(i: Inputs) -> Inputs:
    """Every other frame is another server's; its numbers are its own."""
    assert i.mocap is not None
    return put("mocap", frame_number=i.mocap.frame_number + 1_000_000)(i) if i.tick % 2 else i


def dragged(i: Inputs) -> Inputs:
    """From 2.8 s on the poses are dragged by 1.2 m/s, and PX4's position follows them; its IMU measures no motion."""
    by_m = 1.2 * max(0.0, i.t_s - START_S - 2.8)
    return both(moved("mocap", (by_m, 0.0, 0.0)), moved("vehicle", (by_m, 0.0, 0.0)))(i)


def estimator(**fields: float) -> Change:
    return lambda i: put("estimator", **fields)(fed_by_another(i))


class Swinging(FlightContext):
    """The position error swings by 0.24 m to and fro, twice a second: it is read twice in each tick."""

    _reads = 0

    @property
    def control(self) -> ControlLog:
        self._reads += 1
        error_m = 0.12 * math.sin(2.0 * math.tau * self._reads * 0.5 * TICK_S)
        return control(error=(error_m, *ZERO8[1:]))

    @control.setter
    def control(self, _: ControlLog) -> None: ...


def swinging() -> FlightContext:
    return Swinging(**{name: getattr(flying(), name) for name in ("airborne", "offboard_expected", "tracking_error_m")})


def swinging_joint(i: Inputs) -> Inputs:
    return put("arm", velocity_rad_s=(0.7 + 1.5 * math.sin(math.tau * 16.0 * (i.t_s - START_S)), 0.0))(i)


def heard(**fields: object) -> Change:
    """What the other vehicle of a team says."""

    def change(i: Inputs) -> Inputs:
        partner = with_partner(i).partner
        assert partner is not None
        return replace(i, partner=replace(partner, said=replace(partner.said, **fields)))

    return change


def bar(tilt_deg: float, *, seen_ticks: int = 1000) -> Change:
    """The bar between the two vehicles as motion capture sees it; x points along it. It turns about itself as it likes."""
    attitude = quat_from_euler_zyx(math.radians(70.0), math.radians(tilt_deg), math.radians(130.0))

    def change(i: Inputs) -> Inputs:
        pose = BarPose(
            stamp_s=i.t_s, position_world_m=(0.0, 0.6, 0.9), attitude_wxyz=attitude, tracking_valid=i.tick < seen_ticks
        )
        return replace(i, bar=pose)

    return change


def carrying(**changes: object) -> FlightContext:
    return flying(grip=Grip.CARRYING, **changes)


def unheard(i: Inputs) -> Inputs:
    """The other vehicle has said nothing since the start."""
    return replace(i, partner=with_partner(healthy()).partner)


FAULTS: dict[str, Fault] = {
    "partner_quiet": Fault(unheard),
    "partner_silent": Fault(unheard, carrying),
    "partner_late": Fault(heard(server_s=START_S - 0.5), carrying, sound=0),
    "partner_holds": Fault(heard(holds=True), carrying),
    "partner_lands": Fault(heard(lands=True), carrying),
    "partner_let_go": Fault(heard(grip=Grip.FREE), carrying),
    "partner_near": Fault(heard(position_world_m=(0.0, 1.0, 1.0)), carrying),
    "bar_force_high": Fault(context=lambda: carrying(control=control(force_ext_world_n=(0.0, 12.0, 0.0)))),
    "bar_tilted": Fault(bar(-14.0), carrying),
    "bar_unseen": Fault(bar(9.0, seen_ticks=3), carrying, sound=0),
    "estimator_silent": Fault(lambda i: replace(i, estimator=fed_by_another(healthy()).estimator)),
    "vision_lost": Fault(estimator(flags=0b1111)),
    "vision_rejected": Fault(estimator(position_horizontal_ratio=1.2)),
    "mocap_not_finite": Fault(put("mocap", position_world_m=(NAN, 0.0, 1.0)), also=frozenset({"mocap_lost"})),
    "vehicle_not_finite": Fault(
        put("vehicle", velocity_world_m_s=(0.0, math.inf, 0.0)), also=frozenset({"vehicle_state_lost"})
    ),
    "status_not_finite": Fault(put("status", battery_voltage_v=NAN), also=frozenset({"heartbeat_lost"})),
    "arm_not_finite": Fault(put("arm", torque_nm=(0.0, NAN)), also=frozenset({"arm_lost"})),
    "force_not_finite": Fault(put("force", force_sensor_n=(0.0, 0.0, -math.inf)), also=frozenset({"force_lost"})),
    "mocap_lost": Fault(stopped("mocap")),
    "mocap_invalid": Fault(put("mocap", tracking_valid=False)),
    "mocap_slow": Fault(every_35_ms),
    "mocap_late": Fault(put("mocap", latency_s=0.08)),
    "mocap_too_late": Fault(put("mocap", latency_s=0.2)),
    "mocap_jump": Fault(jumping),
    "mocap_swapped": Fault(moved("mocap", (0.0, 0.3, 0.0)), also=frozenset({"mocap_jump"})),
    "mocap_frozen": Fault(frozen_values("mocap", "position_world_m", "attitude_wxyz")),
    "mocap_two_streams": Fault(two_streams),
    "mocap_dragged": Fault(dragged),
    "estimate_disagrees": Fault(drifting),
    "yaw_disagrees": Fault(turning),
    "vehicle_state_lost": Fault(stopped("vehicle")),
    "estimate_frozen": Fault(frozen_values("vehicle", "position_world_m", "velocity_world_m_s")),
    "heartbeat_lost": Fault(stopped("status")),
    "px4_rebooted": Fault(put("vehicle", boot_s=2.0), also=frozenset({"link_late"})),
    "link_slow": Fault(lambda i: put("vehicle", boot_s=i.t_s - 0.03)(i)),
    "link_late": Fault(slow_link),
    "killed": Fault(put("status", system_status=8)),
    "armed_externally": Fault(context=lambda: flying(found_armed=FOUND)),
    "px4_disarmed": Fault(put("status", armed=False)),
    "pilot_took_over": Fault(put("status", mode=FlightMode.MANUAL)),
    "offboard_left": Fault(put("status", mode=FlightMode.LAND)),
    "battery_warn": Fault(put("status", battery_remaining=0.25)),
    "battery_low": Fault(put("status", battery_remaining=0.1), also=frozenset({"battery_warn"})),
    "battery_silent": Fault(lambda i: put("status", battery_stamp_s=i.t_s - 10.1)(i)),
    "battery_voltage": Fault(put("status", battery_voltage_v=13.0)),
    "arm_lost": Fault(stopped("arm")),
    "arm_read_failures": Fault(put("arm", read_failures=5)),
    "joint_states_late": Fault(lambda i: put("arm", stamp_s=i.t_s - 0.012)(i)),
    "joint_swings": Fault(swinging_joint, also=frozenset({"joint_swings_on"})),
    "joint_swings_on": Fault(swinging_joint, also=frozenset({"joint_swings"})),
    "torque_refused": Fault(context=lambda: flying(torque_refused="joint torque (nan, 0.0) is not finite")),
    "servo_error": Fault(put("arm", hardware_error=(0, 32))),
    "clamp_error": Fault(lambda i: replace(i, clamp=ClampState(i.t_s, 3.0, hardware_error=32))),
    "servo_watchdog_tripped": Fault(put("arm", hardware_error=(0x80, 0))),
    "servo_warm": Fault(put("arm", temperature_c=(35.0, 68.0))),
    "servo_hot": Fault(put("arm", temperature_c=(76.0, 35.0))),
    "servo_overload": Fault(put("arm", torque_nm=(-2.5, 0.1))),
    "joint_jump": Fault(put("arm", angle_rad=(2.0, 1.5))),
    "joint_rate": Fault(put("arm", velocity_rad_s=(0.0, 13.0))),
    "joint_beyond_limit": Fault(put("arm", angle_rad=(math.radians(180.0), 1.0)), sound=0),
    "joint_far_beyond_limit": Fault(
        put("arm", angle_rad=(2.0, math.radians(-25.0))), sound=0, also=frozenset({"joint_beyond_limit"})
    ),
    "force_lost": Fault(lambda i: replace(i, force=None)),
    "force_overload": Fault(put("force", overload=True)),
    "force_stuck": Fault(frozen_values("force", "force_sensor_n", "torque_sensor_nm")),
    "force_drift": Fault(context=lambda: flying(control=control(force_ext_world_n=(3.5, 0.0, 0.0)))),
    "force_disagrees": Fault(
        context=lambda: flying(control=control(force_ext_world_n=(0.0, 0.0, 1.5)), disturbance_world_n=(0.0, 0.0, -1.5))
    ),
    "loop_late": Fault(),
    "loop_stalled": Fault(),
    "recorder_drops": Fault(lambda i: replace(i, recorder_dropped=3)),
    "guardian_lost": Fault(lambda i: replace(i, guardian_ready=False)),
    "tilt": Fault(leaning(45.0), sound=0),
    "oscillates": Fault(put("vehicle", angular_rate_body_rad_s=(0.0, 0.4, 0.0)), context=swinging),
    "crashed": Fault(leaning(120.0), sound=0, also=frozenset({"tilt"})),
    "tracking_warn": Fault(context=lambda: flying(tracking_error_m=0.5)),
    "tracking_hold": Fault(context=lambda: flying(tracking_error_m=0.7), also=frozenset({"tracking_warn"})),
    "tracking_error": Fault(
        context=lambda: flying(tracking_error_m=1.2), also=frozenset({"tracking_warn", "tracking_hold"})
    ),
    "contact_force_high": Fault(context=lambda: flying(contact_n=15.0)),
    "thrust_saturated": Fault(
        context=lambda: flying(
            control=control(saturated=(True, False, False), tau=(0.0, 0.0, 54.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        )
    ),
    "too_fast": Fault(at(0.0, 0.0, 1.0, vx=0.0, vy=2.1), sound=0, also=frozenset({"geofence_near"})),
    "climbs_too_fast": Fault(at(0.0, 0.0, 0.6, vz=1.6), sound=0),
    "sinks_too_fast": Fault(at(0.0, 0.0, 1.5, vz=-1.6), sound=0),
    "geofence_near": Fault(at(1.6, 0.0, 1.0, vx=0.8), sound=0),
    "geofence_left": Fault(at(-1.9, 0.0, 1.0), sound=0, also=frozenset({"geofence_near"})),
    "tether_short": Fault(context=lambda: tethered(stop_slack_m=0.05)),
    "tether_taut": Fault(context=lambda: tethered(taut=True)),
    "tether_snagged": Fault(context=lambda: tethered(snagged=True)),
    "tether_near": Fault(context=lambda: tethered(clearance_m=0.0)),
    "tether_wound": Fault(context=lambda: tethered(turns=-1.6)),
    "tether_separated": Fault(context=lambda: tethered(separated=True)),
    "operator_hold": Fault(lambda i: replace(i, command=OperatorCommand.HOLD)),
    "operator_resume": Fault(lambda i: replace(i, command=OperatorCommand.RESUME)),
    "operator_start": Fault(lambda i: replace(i, command=OperatorCommand.START)),
    "operator_land": Fault(lambda i: replace(i, command=OperatorCommand.LAND)),
    "operator_abort": Fault(lambda i: replace(i, command=OperatorCommand.ABORT)),
}


def stream(rule_id: str) -> list[Inputs]:
    if rule_id in ("loop_late", "loop_stalled"):
        gap_s = 0.2 if rule_id == "loop_late" else 1.0
        return [healthy(k, START_S + k * TICK_S + (gap_s if k > 2 else 0.0)) for k in range(700)]
    fault = FAULTS[rule_id]
    return after_a_moment(fault.change, sound=fault.sound)


def seen_by(rule: Rule) -> tuple[Vehicle, list[Inputs]]:
    """The machine to which the rule belongs, and what it sees."""
    if rule.subject is Subject.PARTNER:
        return MEMBER, [i if i.partner is not None else with_partner(i) for i in stream(rule.id)]
    if rule.subject is not Subject.VISION:
        return VEHICLE, stream(rule.id)
    return EXTERNAL, [fed_by_another(i) for i in stream(rule.id)]


REPEATS = {
    "force_stuck": frozen_values("force", "force_sensor_n", "torque_sensor_nm"),
    "mocap_frozen": frozen_values("mocap", "position_world_m", "attitude_wxyz"),
    "estimate_frozen": frozen_values("vehicle", "position_world_m"),
}
