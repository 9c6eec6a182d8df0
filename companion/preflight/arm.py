"""Checks of the arm: servo models, settings, hardware errors, communication, and joint limits. Pure functions."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import reduce
from operator import or_

from companion.config.vehicle import Vehicle
from companion.io.dynamixel.registers import cycle_bytes, cycle_s
from companion.model.check_row import Row
from companion.model.constants import TICK_PERIOD_S
from companion.model.listing import listed
from companion.model.observations import Observations, ServoReport
from companion.model.servos import WATCHDOG_ERROR, ServoKind, model_text
from companion.model.types import ArmState
from companion.preflight.checks import Check
from companion.safety.arm import error_text

DEVICE = Check(
    "arm.device",
    "arm bus",
    "the port opens, and all servos answer and accept their settings; a vehicle without `arm` only warns",
    "the flight needs the arm",
)
MODEL = Check(
    "arm.model",
    "servos",
    "the models of `arm.joints[].servo` (register 0); an XC330 or XL330 warns, because its current is that of its supply",
    "other models have a different torque constant and different registers",
)
FIRMWARE = Check(
    "arm.firmware",
    "servo firmware",
    "38 or newer (53 for the 330 models), the same on all servos of one model",
    "older firmware has no bus watchdog, or other register addresses",
)
MODE = Check(
    "arm.mode",
    "operating mode",
    "current control (register 11 is 0)",
    "in any other mode a torque command has a different meaning",
)
RETURN_DELAY = Check(
    "arm.return_delay",
    "return delay",
    "0 us (register 9)",
    "the factory setting of 500 us per servo takes a fifth of a control tick",
)
WATCHDOG = Check(
    "arm.watchdog",
    "bus watchdog",
    "`devices.arm.watchdog_ms` (register 98); of an arm that a plug-in drives, what the plug-in states",
    "the arm would keep its torque if the companion died",
)
CURRENT_LIMIT = Check(
    "arm.current_limit",
    "current limit",
    "at least the current for `torque_max_nm` (register 38)",
    "the arm would be weaker than the controller assumes",
)
VOLTAGE = Check(
    "arm.voltage",
    "servo supply",
    "the range of each servo's model, such as 10.0 to 14.8 V for the XM430",
    "outside this range the servos report an input voltage error and switch their torque off",
)
TEMPERATURE = Check(
    "arm.temperature",
    "servo temperature",
    "below `safety.servo_warn_c`; refused at `safety.servo_max_c` or above",
    "at 80 degC (70 degC for the 330 models) a servo switches its torque off",
)
ERROR = Check(
    "arm.error",
    "servo hardware error",
    "none (register 70); a tripped bus watchdog only warns",
    "a servo with an error gives no torque until it is rebooted",
)
ANGLES = Check(
    "arm.angles",
    "joint angles",
    "within the limits of all joints",
    "beyond a limit the links touch the airframe; or zero_count or sign is wrong",
)
BUS_TIME = Check(
    "arm.bus_time",
    "time of a bus cycle",
    "at most 4 ms of the control tick of 5 ms, from `devices.arm.baud`, the number of servos and their return delay",
    "the bus cannot read and write the joints in every control tick: torques would come late and irregularly",
)
STILL = Check("arm.still", "arm at rest", "moves less than 3 deg", "motion of the arm makes the tare wrong")
READS = Check(
    "arm.reads",
    "bus cycles without an answer",
    "at most 0.1 %; refused above 10 %, if that is more than `safety.arm_read_failures_max`",
    "`safety.arm_read_failures_max` of them in a row end the flight",
)
USB = Check(
    "arm.usb_latency",
    "arm's USB latency timer",
    "1 ms, or no FTDI adapter",
    "a longer time delays control ticks; at 5 ms or more the driver refuses the bus",
    warns=True,
)
CHECKS = (
    DEVICE, BUS_TIME, MODEL, FIRMWARE, MODE, RETURN_DELAY, WATCHDOG, CURRENT_LIMIT, VOLTAGE, TEMPERATURE, ERROR, ANGLES, STILL,
    READS, USB,
)  # fmt: skip

MODE_CURRENT = 0
MODES = {0: "current", 1: "velocity", 3: "position", 4: "extended position", 5: "current-based position", 16: "PWM"}
STILL_RAD = math.radians(3.0)
MISSED_GOOD, MISSED_MAX = 0.001, 0.1
LATENCY_GOOD_MS = 1
CYCLE_MAX_S = 0.8 * TICK_PERIOD_S
"""Longest bus cycle; the rest of the tick is for the USB adapter, whose latency timer is 1 ms."""
BAUD_ENOUGH = 1_000_000
"""Baud rate at which seven servos take 2.2 ms."""


def rows(o: Observations, vehicle: Vehicle) -> Iterator[Row]:
    """Return the rows of the arm, or one warning if the vehicle has none."""
    if not vehicle.arm.joints:
        fix = "add arm and devices.arm to the vehicle file if an arm is mounted; without it, the vehicle flies as a plain multirotor"
        yield DEVICE.doubtful("none; joints and servos are not monitored", "", fix)
        return
    failure = o.failures.get("arm")
    if failure is not None:
        yield DEVICE.bad(failure)
        return
    stated = o.arm_statement
    if stated is not None:
        yield DEVICE.good(f"{vehicle.arm_device.type}: {stated.product}")
        yield WATCHDOG.good(f"as {vehicle.arm_device.type} states: {stated.watchdog}")
    else:
        yield DEVICE.good(f"{vehicle.arm_device.port} at {vehicle.arm_device.baud} baud")
    if o.servos:
        yield _bus_time(vehicle, o.servos)
        yield from _settings(o.servos, vehicle)
    if o.arm:
        yield from _states(o.arm, vehicle, temperatures_unknown=stated is not None)
    if o.arm_reads is not None:
        yield _reads(*o.arm_reads, vehicle.safety.arm_read_failures_max)
    if o.machine is not None and stated is None:
        yield usb_latency(USB, o.machine.arm_latency_ms)


def _settings(servos: Sequence[ServoReport], vehicle: Vehicle) -> Iterator[Row]:
    kinds = [joint.kind for joint in vehicle.arm.joints]
    read = ", ".join(f"id {servo.servo_id}: {model_text(servo.model)}" for servo in servos)
    wanted = _each([kind.name for kind in kinds])
    if any(servo.model != kind.number for servo, kind in zip(servos, kinds, strict=True)):
        fix = "install the configured servo, or correct arm.joints[].servo_id or arm.joints[].servo"
        yield MODEL.bad(read, wanted, fix)
    elif any(kind.supply_current for kind in kinds):
        named = ", ".join(dict.fromkeys(kind.name for kind in kinds if kind.supply_current))
        fix = f"{named}: its current is that of the supply, so that the torque is inexact; measure it with companion arm friction"
        yield MODEL.doubtful(read, wanted, fix)
    else:
        yield MODEL.good(read, wanted)
    yield firmware(FIRMWARE, [(kind, servo.firmware) for servo, kind in zip(servos, kinds, strict=True)])
    modes = [mode_text(servo.operating_mode) for servo in servos]
    fix = "another program has changed it: close that program, then cycle the servos' power"
    yield _equal(MODE, modes, mode_text(MODE_CURRENT), fix)
    delays = [f"{servo.return_delay_us} us" for servo in servos]
    yield _equal(RETURN_DELAY, delays, "0 us", "another program has changed it: close that program, then start again")
    watchdogs = [f"{servo.watchdog_ms} ms" for servo in servos]
    wanted = f"{vehicle.arm_device.watchdog_ms} ms"
    yield _equal(WATCHDOG, watchdogs, wanted, "cycle the servos' power; check for a loose supply cable")
    yield _current_limit(servos, vehicle)
    yield supply(VOLTAGE, [(kind, servo.voltage_v) for servo, kind in zip(servos, kinds, strict=True)])


def _bus_time(vehicle: Vehicle, servos: Sequence[ServoReport]) -> Row:
    count, baud = len(vehicle.arm.joints) + (vehicle.jaws is not None), vehicle.arm_device.baud
    takes_s = cycle_s(count, baud) + 1e-6 * sum(servo.return_delay_us for servo in servos)
    read = f"{takes_s * 1e3:.2g} ms ({count} servos, {cycle_bytes(count)} bytes at {baud} baud)"
    wanted = f"at most {CYCLE_MAX_S * 1e3:g} ms"
    return BUS_TIME.row(
        takes_s <= CYCLE_MAX_S, read, wanted, f"set the servos and devices.arm.baud to {BAUD_ENOUGH} baud or more"
    )


def firmware(check: Check, versions: Sequence[tuple[ServoKind, int]]) -> Row:
    """Return the row of the servos' firmware, given the model and the version of each."""
    read = _each([version for _, version in versions])
    wanted = _each([f"{kind.firmware_min} or newer" for kind, _ in versions])
    fix = "update with DYNAMIXEL Wizard: Recovery, newest firmware"
    new_enough = all(version >= kind.firmware_min for kind, version in versions)
    if new_enough and len(set(versions)) > len({kind for kind, _ in versions}):
        return check.doubtful(read, f"{wanted}, the same on all servos of one model", fix)
    return check.row(new_enough, read, wanted, fix)


def supply(check: Check, volts: Sequence[tuple[ServoKind, float]]) -> Row:
    """Return the row of the servos' supply voltage, given the model and the voltage of each."""
    read = _each([f"{volt:.1f} V" for _, volt in volts])
    ranges_v = [kind.voltage_v for kind, _ in volts]
    wanted = _each([f"{low_v:g} to {high_v:g} V" for low_v, high_v in ranges_v])
    within = all(low_v <= volt <= high_v for (low_v, high_v), (_, volt) in zip(ranges_v, volts, strict=True))
    return check.row(
        within,
        read,
        wanted,
        "supply each servo with its voltage, 12 V for the XM430, from a converter; check its plugs",
    )


def _current_limit(servos: Sequence[ServoReport], vehicle: Vehicle) -> Row:
    arm = vehicle.arm
    per_count_nm = [
        nm_a * joint.kind.current_unit_a for nm_a, joint in zip(arm.torque_constants_nm_a, arm.joints, strict=True)
    ]
    limits = [servo.current_limit_counts for servo in servos]
    needed = [math.floor(joint.torque_max_nm / nm + 1e-9) for joint, nm in zip(arm.joints, per_count_nm, strict=True)]
    read = _each([f"{limit} ({limit * nm:.2f} N m)" for limit, nm in zip(limits, per_count_nm, strict=True)])
    wanted = f"at least {_each(needed)}"
    enough = all(limit >= need for limit, need in zip(limits, needed, strict=True))
    fix = "raise register 38 with DYNAMIXEL Wizard, or lower arm.joints[].torque_max_nm"
    return CURRENT_LIMIT.row(enough, read, wanted, fix)


def _states(states: Sequence[ArmState], vehicle: Vehicle, *, temperatures_unknown: bool) -> Iterator[Row]:
    last, safety = states[-1], vehicle.safety
    hottest_c = max(max(state.temperature_c) for state in states)
    read, wanted = f"{hottest_c:.0f} degC", f"below {safety.servo_warn_c:g} degC"
    if temperatures_unknown and min(states[-1].temperature_c) == 0.0:
        yield TEMPERATURE.doubtful(
            "not reported by every motor", wanted, "limit the motors' temperature by their own settings"
        )
    else:
        cool, tolerable = hottest_c < safety.servo_warn_c, hottest_c < safety.servo_max_c
        fix = "let the arm cool down; check for a jammed joint or a load on the arm"
        yield TEMPERATURE.graded(cool, tolerable, read, wanted, fix)
    errors = [reduce(or_, servo) for servo in zip(*(state.hardware_error for state in states), strict=True)]
    named = error_text(errors)
    if named:
        yield ERROR.bad(named, "none", "remove the cause, then run companion arm reboot")
    elif any(error & WATCHDOG_ERROR for error in errors):
        fix = "check for a loose cable or supply, and for a computer that stalls"
        yield ERROR.doubtful("a bus watchdog tripped", "none", fix)
    else:
        yield ERROR.good("none", "none")
    yield _angles(last, vehicle)
    moved_rad = max(max(angles) - min(angles) for angles in zip(*(state.angle_rad for state in states), strict=True))
    read, wanted = f"moves by {math.degrees(moved_rad):.1f} deg", f"{math.degrees(STILL_RAD):.0f} deg"
    fix = "fold the arm so that it rests on its own, and do not touch it"
    yield STILL.row(moved_rad <= STILL_RAD, read, wanted, fix)


def _angles(last: ArmState, vehicle: Vehicle) -> Row:
    degrees = [math.degrees(angle) for angle in last.angle_rad]
    limits = [joint.angle_deg for joint in vehicle.arm.joints]
    read = f"({listed(degrees, '.0f')}) deg"
    wanted = " and ".join(f"{low:g} to {high:g} deg" for low, high in limits)
    within = all(low <= angle <= high for angle, (low, high) in zip(degrees, limits, strict=True))
    return ANGLES.row(within, read, wanted, "move the arm by hand, or correct zero_count and sign of the joint")


def _reads(cycles: int, missed: int, warned_of: int) -> Row:
    share = missed / max(1, cycles)
    read, wanted = f"{missed} of {cycles}", f"{MISSED_GOOD:.1%}"
    fix = "check for a loose cable, a bad ground or interference on the servo bus"
    few = share <= MISSED_MAX or missed <= warned_of
    return READS.graded(cycles > 0 and share <= MISSED_GOOD, cycles > 0 and few, read, wanted, fix)


def usb_latency(check: Check, latency_ms: int | None) -> Row:
    """Return the row of a USB adapter's latency timer; also used for the force sensor's port."""
    wanted = f"{LATENCY_GOOD_MS} ms"
    if latency_ms is None:
        return check.good("not an FTDI adapter", wanted)
    fix = "keep it at 1 ms with a udev rule (see docs/first-flight.md, step 2)"
    return check.row(latency_ms <= LATENCY_GOOD_MS, f"{latency_ms} ms", wanted, fix)


def _equal(check: Check, values: Sequence[str], wanted: str, fix: str) -> Row:
    return check.row(set(values) == {wanted}, _each(values), wanted, fix)


def _each(values: Sequence[object]) -> str:
    return str(values[0]) if len(set(values)) == 1 else " and ".join(map(str, values))


def mode_text(mode: int) -> str:
    """Return an operating mode with its name."""
    return f"{mode} ({MODES.get(mode, 'unknown')})"
