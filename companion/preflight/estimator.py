"""Checks of PX4's telemetry: alive, disarmed, fusing motion capture, battery charged. `preflight.px4` checks firmware and
parameters. Pure functions.

PX4 accepts poses without fusing them, and does not report it. Only the estimator's own status and position over the whole
observation prove fusion.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from companion.config.vehicle import Vehicle
from companion.model.check_row import Row
from companion.model.constants import GRAVITY_M_S2
from companion.model.estimator import EstimatorReport
from companion.model.flight_stage import is_killed
from companion.model.frames import wrap_rad, yaw_from_quat
from companion.model.observations import Observations
from companion.model.types import FlightMode, MocapPose, VehicleState
from companion.preflight.checks import Check
from companion.px4.required import HOVER as HOVER_PARAM
from companion.px4.required import KILL_CHANNEL, NO_RADIO, RADIO
from companion.safety.mocap import FUSED_WITHIN_M, FUSED_WITHIN_RAD

DEVICE = Check("px4.device", "PX4", "the link opens and PX4 answers", "the flight needs PX4")
HEARTBEAT = Check(
    "px4.heartbeat",
    "PX4 heartbeat",
    "newer than `safety.heartbeat_timeout_s`",
    "a link that loses heartbeats also loses setpoints, and the flight ends in PX4's failsafe",
)
DISARMED = Check("px4.disarmed", "PX4 is disarmed", "disarmed", "an armed vehicle must be landed, not checked")
RATES = Check(
    "px4.rates",
    "PX4 state rates",
    "position, attitude and IMU at 80 Hz or more; refused below 40 Hz",
    "the controller uses this state at 200 Hz; if it is stale, the vehicle oscillates",
)
LAG = Check(
    "px4.lag",
    "PX4 link lag",
    "at most `safety.link_lag_max_s` above the shortest delay",
    "a delayed state makes the control unstable",
    warns=True,
)
VISION = Check(
    "px4.vision",
    "EKF2 fuses motion capture",
    "throughout: local position; flags of attitude, velocity and position; test ratios above 0 and below 1; accuracy below 0.1 m",
    "PX4 accepts poses without fusing them; in flight the vehicle would drift away",
    settles=True,
)
AGREES = Check(
    "px4.agrees",
    "PX4 compared with motion capture",
    "within 0.10 m and 8 deg of yaw",
    "PX4 would hold a different position or heading from the mission's",
    settles=True,
)
STEADY = Check(
    "px4.steady",
    "PX4's estimate at rest",
    "varies by less than 0.04 m and 3 deg relative to motion capture; if another program feeds PX4, relative to the ground",
    "the vehicle follows a drifting estimate at take-off",
    settles=True,
)
BATTERY = Check(
    "px4.battery",
    "battery",
    "at least `safety.battery_warn` of charge and `safety.battery_voltage_min_v`",
    "below `safety.battery_min` the vehicle lands at once",
)
KILL_SWITCH = Check(
    "px4.kill_switch",
    "kill switch",
    "released; mapped to a channel (`RC_MAP_KILL_SW`) of a radio that PX4 receives, unless `COM_RC_IN_MODE` is 4",
    "the pilot could not stop the rotors at once",
)
HOVER = Check(
    "px4.hover_thrust",
    "hover thrust",
    "within 15 % of the weight divided by `airframe.thrust_max_n`; refused beyond 35 % (a value from PX4 has its own row)",
    "it determines the thrust in the first second: if it is too high, the vehicle jumps; if too low, it does not take off",
)
CHECKS = (DEVICE, HEARTBEAT, DISARMED, RATES, LAG, VISION, AGREES, STEADY, BATTERY, KILL_SWITCH, HOVER)

RATE_GOOD_HZ, RATE_MIN_HZ = 80.0, 40.0
ACCURACY_MAX_M = 0.1
COVER_S = 0.6
"""A stream covers the observation if its first and its last sample are within this time of the beginning and the end."""
PAIR_S = 0.1
STEADY_M, STEADY_RAD = 0.04, math.radians(3.0)
HOVER_GOOD, HOVER_MAX = 0.15, 0.35
# ESTIMATOR_STATUS_FLAGS. PX4 sets the absolute horizontal one only once it knows a global origin, which is not needed here, and the
# one of constant position whenever the vehicle is at rest.
FLAGS = {1: "attitude", 2: "horizontal velocity", 4: "vertical velocity", 8: "horizontal position", 32: "height"}


def rows(o: Observations, vehicle: Vehicle) -> Iterator[Row]:
    """Return the rows of PX4's telemetry."""
    failure = o.failures.get("autopilot")
    if failure is not None:
        yield DEVICE.bad(failure)
        return
    yield DEVICE.good(f"answers on {vehicle.devices.autopilot.address}")
    yield _heartbeat(o, vehicle)
    yield _disarmed(o)
    if o.state_counts is not None:
        yield _rates(o)
    if any(state.boot_s is not None for state in o.vehicle):
        yield _lag(o, vehicle)
    external = vehicle.devices.mocap.external
    yield vision(o, external)
    if o.mocap and o.vehicle:
        yield from agreement(o)
    elif external and o.vehicle:
        yield _steady(o.vehicle)
    if o.status:
        yield _battery(o, vehicle)
        if RADIO in o.params:
            yield _kill_switch(o, vehicle)
    hover = vehicle.airframe.hover_thrust or o.params.get(HOVER_PARAM)
    if hover is not None:
        yield _hover(float(hover), vehicle)


def _heartbeat(o: Observations, vehicle: Vehicle) -> Row:
    limit_s = vehicle.safety.heartbeat_timeout_s
    wanted = f"newer than {limit_s:g} s"
    if not o.status:
        return HEARTBEAT.bad("no heartbeat", wanted, "check link and baud rate")
    age_s = max(0.0, o.start_s + o.duration_s - o.status[-1].heartbeat_stamp_s)
    read = f"{age_s:.1f} s old" if age_s <= limit_s else f"none for {age_s:.1f} s"
    return HEARTBEAT.row(age_s <= limit_s, read, wanted, "check cable, baud rate and PX4's power")


def _disarmed(o: Observations) -> Row:
    if any(status.armed for status in o.status):
        return DISARMED.bad("armed", "disarmed", "disarm it with the radio or QGroundControl, then start again")
    mode = o.status[-1].mode if o.status else FlightMode.UNKNOWN
    return DISARMED.good(f"disarmed, mode {mode.value.upper()}")


def _rates(o: Observations) -> Row:
    counts = o.state_counts
    assert counts is not None
    rates_hz = [count / o.duration_s for count in (counts.position, counts.attitude, counts.imu)]
    read = "position {:.0f}, attitude {:.0f}, IMU {:.0f} Hz".format(*rates_hz)
    wanted = f"{RATE_GOOD_HZ:g} Hz each"
    if rates_hz[0] == 0.0:
        fix = "PX4 sends no position until it fuses motion capture: see the row 'EKF2 fuses motion capture'"
    else:
        fix = "make the link faster: 921600 baud, MAV_x_RATE 80000 or more, MAV_x_MODE onboard (docs/px4.md)"
    return RATES.graded(min(rates_hz) >= RATE_GOOD_HZ, min(rates_hz) >= RATE_MIN_HZ, read, wanted, fix)


def _lag(o: Observations, vehicle: Vehicle) -> Row:
    """Return the row on delays over the whole observation: arrival minus PX4's own stamp, relative to the smallest difference."""
    offsets_s = sorted(state.attitude_stamp_s - state.boot_s for state in o.vehicle if state.boot_s is not None)
    late_s = offsets_s[int(0.99 * (len(offsets_s) - 1))] - offsets_s[0]
    limit_s = vehicle.safety.link_lag_max_s
    read, wanted = f"{late_s * 1e3:.0f} ms at the 99th percentile", f"{limit_s * 1e3:.0f} ms"
    fix = "reduce other traffic on the link and the load on this computer"
    return LAG.row(late_s <= limit_s, read, wanted, fix)


def vision(o: Observations, external: bool = False) -> Row:
    """Return the row on evidence of fusion over the whole observation; `external` if another program feeds PX4."""
    missing = missing_evidence(o)
    wanted = f"fused for {o.duration_s:.0f} s"
    if missing is None:
        last = o.estimator[-1]
        accuracy_m = max(last.position_horizontal_accuracy_m, last.position_vertical_accuracy_m)
        ratio = max(_ratios(last))
        return VISION.good(
            f"fused for {o.duration_s:.0f} s, accuracy {accuracy_m:.3f} m, test ratio {ratio:.2f}", wanted
        )
    fix = "check EKF2_EV_CTRL = 11 and EKF2_HGT_REF = 3, and that the body is tracked; then reboot PX4"
    if external:
        fix = "start the program that sends poses to PX4, and check EKF2_EV_CTRL = 11 and EKF2_HGT_REF = 3"
    elif not o.mocap:
        fix = "motion capture is missing: see its rows first"
    return VISION.bad(missing, wanted, fix)


def missing_evidence(o: Observations) -> str | None:
    """Return why the observation does not show that EKF2 fuses vision throughout, or None if it does."""
    if not o.vehicle:
        return "no LOCAL_POSITION_NED"
    if not o.estimator:
        return "no ESTIMATOR_STATUS"
    if o.vehicle[0].position_stamp_s > o.start_s + COVER_S or o.estimator[0].stamp_s > o.start_s + COVER_S:
        return "the estimate has just begun"
    end_s = o.start_s + o.duration_s
    if o.vehicle[-1].position_stamp_s < end_s - COVER_S or o.estimator[-1].stamp_s < end_s - COVER_S:
        return "the estimate has stopped"
    for report in o.estimator:
        lacking = [name for bit, name in FLAGS.items() if not report.flags & bit]
        if lacking:
            return f"the estimator reports no valid {', '.join(lacking)}"
    if all(max(_ratios(report)[1:]) == 0.0 for report in o.estimator):
        return "the innovation test ratios of position are 0: nothing is fused"
    worst = max(max(_ratios(report)) for report in o.estimator)
    if worst >= 1.0:
        return f"measurements are rejected (innovation test ratio {worst:.1f})"
    horizontal_m = max(report.position_horizontal_accuracy_m for report in o.estimator)
    vertical_m = max(report.position_vertical_accuracy_m for report in o.estimator)
    if not max(horizontal_m, vertical_m) < ACCURACY_MAX_M:
        return f"the estimator's own accuracy is {horizontal_m:.2f} m, {vertical_m:.2f} m in height"
    return None


def _ratios(report: EstimatorReport) -> tuple[float, float, float]:
    ratios = (report.velocity_ratio, report.position_horizontal_ratio, report.position_vertical_ratio)
    return (_finite(ratios[0]), _finite(ratios[1]), _finite(ratios[2]))


def _finite(ratio: float) -> float:
    """Return the ratio, or 0 if it is not finite: the test ratio of a source that is not fused may be NaN."""
    return ratio if math.isfinite(ratio) else 0.0


def agreement(o: Observations) -> Iterator[Row]:
    """Return the rows on the difference between PX4's pose and motion capture, frame by frame, and on its variation."""
    pairs = list(_pairs(o.vehicle, o.mocap))
    if not pairs:
        fix = "check the rates of PX4's position and of motion capture"
        yield AGREES.bad("no state of PX4 and no pose of motion capture are close enough in time", "", fix)
        return
    apart = [
        tuple(a - b for a, b in zip(state.position_world_m, pose.position_world_m, strict=True))
        for state, pose in pairs
    ]
    turned_rad = [wrap_rad(yaw_from_quat(s.attitude_wxyz) - yaw_from_quat(p.attitude_wxyz)) for s, p in pairs]
    apart_m, yaw_rad = max(math.hypot(*d) for d in apart), max(abs(a) for a in turned_rad)
    read = f"{apart_m:.3f} m and {math.degrees(yaw_rad):.1f} deg of yaw apart"
    wanted = f"{FUSED_WITHIN_M:g} m, {math.degrees(FUSED_WITHIN_RAD):.0f} deg"
    agree = apart_m <= FUSED_WITHIN_M and yaw_rad <= FUSED_WITHIN_RAD
    fix = "check EKF2_EV_CTRL = 11 and EKF2_HGT_REF = 3, and the body's axes in Motive; reboot PX4 after a change"
    yield AGREES.row(agree, read, wanted, fix)
    yield _wander(apart, turned_rad)


def _steady(states: tuple[VehicleState, ...]) -> Row:
    """Return the row on the variation of PX4's own estimate, without motion capture to compare it with."""
    yaws_rad = [yaw_from_quat(state.attitude_wxyz) for state in states]
    return _wander([state.position_world_m for state in states], [wrap_rad(yaw - yaws_rad[0]) for yaw in yaws_rad])


def _wander(places_m: Sequence[Sequence[float]], yaws_rad: Sequence[float]) -> Row:
    wander_m = max(max(p[axis] for p in places_m) - min(p[axis] for p in places_m) for axis in range(3))
    wander_rad = max(yaws_rad) - min(yaws_rad)
    read = f"varies by {wander_m:.3f} m and {math.degrees(wander_rad):.1f} deg"
    wanted = f"{STEADY_M:g} m, {math.degrees(STEADY_RAD):.0f} deg"
    fix = "leave the vehicle at rest; if the estimate does not settle, reboot PX4 and calibrate its gyros"
    return STEADY.row(wander_m <= STEADY_M and wander_rad <= STEADY_RAD, read, wanted, fix)


def _pairs(states: tuple[VehicleState, ...], poses: tuple[MocapPose, ...]) -> Iterator[tuple[VehicleState, MocapPose]]:
    """Pair each state with the tracked pose that is nearest in time."""
    tracked = [pose for pose in poses if pose.tracking_valid]
    index = 0
    for state in states:
        at_s = state.position_stamp_s
        while index + 1 < len(tracked) and abs(tracked[index + 1].stamp_s - at_s) <= abs(tracked[index].stamp_s - at_s):
            index += 1
        if index < len(tracked) and abs(tracked[index].stamp_s - at_s) <= PAIR_S:
            yield state, tracked[index]


def _battery(o: Observations, vehicle: Vehicle) -> Row:
    status, safety = o.status[-1], vehicle.safety
    remaining, voltage_v = status.battery_remaining, status.battery_voltage_v
    voltage_min_v = safety.battery_voltage_min_v
    told = [f"{remaining:.0%}" if remaining is not None else "", f"{voltage_v:.1f} V" if voltage_v is not None else ""]
    read = ", ".join(text for text in told if text) or "PX4 reports neither charge nor voltage"
    wanted = f"{safety.battery_warn:.0%}" + (f", {voltage_min_v:g} V" if voltage_min_v is not None else "")
    if remaining is not None and remaining < safety.battery_warn:
        return BATTERY.bad(read, wanted, "charge the battery")
    if voltage_v is not None and voltage_min_v is not None and voltage_v < voltage_min_v:
        return BATTERY.bad(read, wanted, "charge the battery, or correct safety.battery_voltage_min_v for its cells")
    if remaining is None or (voltage_v is None and voltage_min_v is not None):
        return BATTERY.doubtful(read, wanted, "configure BAT1_SOURCE, BAT1_N_CELLS and the power module in PX4")
    return BATTERY.good(read, wanted)


def _kill_switch(o: Observations, vehicle: Vehicle) -> Row:
    status, channel = o.status[-1], o.params.get(KILL_CHANNEL)
    wanted = "released, mapped, the radio received"
    if is_killed(status):
        return KILL_SWITCH.bad("engaged, or PX4 has terminated a flight", wanted, "release it, or restart PX4")
    if o.params[RADIO] == NO_RADIO:
        read = f"none: no radio ({RADIO} is {NO_RADIO})"
        if vehicle.devices.autopilot.address.startswith("serial"):  # else a simulated vehicle
            return KILL_SWITCH.doubtful(read, wanted, "fly with a radio whose kill switch a pilot holds")
        return KILL_SWITCH.good(read, wanted)
    if not channel:
        return KILL_SWITCH.bad(f"{KILL_CHANNEL} is 0", wanted, "assign a switch of the radio in QGroundControl")
    if not status.radio:
        return KILL_SWITCH.bad(f"channel {channel}; PX4 receives no radio", wanted, "switch the radio on; bind it")
    return KILL_SWITCH.good(f"channel {channel}; the radio is received", wanted)


def _hover(hover: float, vehicle: Vehicle) -> Row:
    airframe = vehicle.airframe
    expected = airframe.mass_kg * GRAVITY_M_S2 / airframe.thrust_max_n
    off = hover / expected - 1.0
    own = airframe.hover_thrust is not None
    source = "airframe.hover_thrust" if own else HOVER_PARAM
    read = f"{source} = {hover:.3f}"
    wanted = f"about {expected:.3f} ({airframe.mass_kg:g} kg, maximum thrust {airframe.thrust_max_n:g} N)"
    fix = f"measure it (companion hover fit) and set {source}, or correct airframe.mass_kg and airframe.thrust_max_n"
    # The parameter's own row refuses a value in PX4 that is far off.
    return HOVER.graded(abs(off) <= HOVER_GOOD, not own or abs(off) <= HOVER_MAX, read, wanted, fix)
