"""`companion latency`: how late motion capture reaches PX4, measured by taps on the airframe; what EKF2_EV_DELAY should be."""

from __future__ import annotations

import argparse
import asyncio
import math
import statistics
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from companion.commissioning.latency.fit import (
    APART_S,
    SETTLE_S,
    STRENGTH_MIN_M_S2,
    TAPS_MIN,
    Delay,
    PoseSample,
    Tap,
    TapDelay,
    agreeing,
    combine,
    find_taps,
    measure_tap,
    mocap_noise,
)
from companion.commissioning.sensor_report import Result, add_options, ask, finish, run_until_interrupted
from companion.config.document import ConfigError
from companion.config.loader import load_vehicle
from companion.config.vehicle import Vehicle
from companion.io.protocols import DeviceError
from companion.model.rows import Row
from companion.model.types import MocapPose
from companion.preflight.checks import Check
from companion.px4.wanted import WANTED
from companion.runtime.clock import Clock, flight_clock
from companion.runtime.console import tell
from companion.runtime.realtime import FLIGHT_PRIORITY, claim_realtime

if TYPE_CHECKING:
    from companion.commissioning.latency.link import LatencyLink

PARAMETER = "EKF2_EV_DELAY"
TOLERANCE_MS = 3.0
TAPS_SPAN = (TAPS_MIN, 60)
SECONDS_SPAN = (5.0, 600.0)
_LOOK_S = 0.5
_WINDOW_S = 3.0
_HISTORY_POSES_MIN = 50
_DIGITS = 1
"""Of a delay in ms."""

DEVICES = Check(
    "latency.devices", "PX4 and motion capture", "both are there, PX4 is disarmed", "there is nothing to compare"
)
TAPS = Check(
    "latency.taps", "taps", "at least 5 that IMU and motion capture both show", "nothing is known of the delay"
)
DELAY = Check(
    "latency.delay",
    "EKF2_EV_DELAY",
    "as measured, within 3 ms",
    "PX4 fuses each pose in the wrong place: the estimate swings with the machine",
)
LONG = Check(
    "latency.long",
    "delay of motion capture",
    "within what the project's parameters allow",
    "the filter works that far in the past; every loop that hangs on it becomes slower",
)
CHECKS = (DEVICES, TAPS, DELAY, LONG)


@dataclass(frozen=True, slots=True)
class Measured:
    """Everything that a session of taps gave."""

    taps: tuple[TapDelay, ...]
    delay: Delay | str
    """At the companion; or why there is none."""
    round_trip_s: float
    imu_age_s: float | None
    mocap_latency_s: float | None
    """Mid-exposure to transmission by the server's stamps, median."""
    px4_ms: float | None
    """EKF2_EV_DELAY as it is; None: PX4 has none."""

    @property
    def total_ms(self) -> float | None:
        """Exposure to arrival in PX4: what EKF2_EV_DELAY means."""
        return None if isinstance(self.delay, str) else 1e3 * (self.delay.delay_s + 0.5 * self.round_trip_s)


def add_parser(commands: Any) -> None:
    """Add `latency` to the sub-parsers of `companion`."""
    latency = commands.add_parser(
        "latency",
        help="how late motion capture is, by taps on the airframe: EKF2_EV_DELAY",
        description="Somebody holds the machine up, disarmed, propellers off, and taps its frame some times; IMU and motion capture "
        "are compared. Exit 0: EKF2_EV_DELAY is right; 3: it is not, or it cannot be told.",
    )
    add_options(latency, patches=False)
    latency.add_argument("--taps", type=int, default=8, metavar="N", help="so many (default: 8)")
    latency.add_argument("--seconds", type=float, default=90.0, metavar="N", help="wait so long for them (default: 90)")
    latency.add_argument("--write", action="store_true", help=f"write {PARAMETER} to PX4, which must then be restarted")
    latency.add_argument("--yes", action="store_true", help="ask nothing")
    latency.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Measure, show, perhaps write; the exit code."""
    vehicle = load_vehicle(arguments.vehicle, arguments.overrides)
    for name, value, (low, high) in (("taps", arguments.taps, TAPS_SPAN), ("seconds", arguments.seconds, SECONDS_SPAN)):
        if not math.isfinite(value) or not low <= value <= high:
            raise ConfigError([f"--{name} {value:g}: expected {low:g} to {high:g}"])
    result = run_until_interrupted(
        measure(vehicle, arguments.taps, arguments.seconds, write=arguments.write, yes=arguments.yes)
    )
    return finish(argparse.Namespace(**{**vars(arguments), "write": False}), result)


async def measure(vehicle: Vehicle, taps: int, seconds: float, *, write: bool = False, yes: bool = False) -> Result:
    """Open both devices, wait for the taps, judge; write if asked."""
    from companion.commissioning.latency.link import LatencyLink  # with it comes MAVSDK
    from companion.io.mocap.driver import NatNetMocap

    clock, devices = flight_clock(), vehicle.devices
    poses: list[MocapPose] = []
    written: float | None = None
    try:
        async with (
            NatNetMocap(devices.mocap, clock, poses.append),
            LatencyLink(devices.autopilot, clock) as link,
        ):
            _refuse_armed(link, devices.autopilot.address)
            # As in flight: a busy computer would stamp motion capture late.
            claim_realtime(FLIGHT_PRIORITY, cpus=vehicle.computer.cpus, lock_memory=False)
            tell(
                f"hold the machine up by its legs, propellers off, and have somebody tap its frame {taps} times with the flat of the "
                "hand, one tap a second, from several sides"
            )
            found = await _tapped(link, clock, poses, taps, seconds)
            measured = replace(await _about_link(link, poses), taps=found, delay=combine(found))
            if write and measured.total_ms is not None and _writable(measured.total_ms, _most_ms(vehicle)):
                value = round(measured.total_ms, _DIGITS)
                if ask(f"write {PARAMETER} = {value:g} ms to PX4?", yes=yes):
                    _refuse_armed(link, devices.autopilot.address)
                    written = float(await link.write_param(PARAMETER, value))
    except DeviceError as error:
        return Result([DEVICES.bad(str(error), "", "")], {"ev_delay_ms": None, "taps": []})
    advice = []
    if written is not None:
        advice.append(f"{PARAMETER} = {written:g} ms is written to PX4 (was {measured.px4_ms} ms); restart PX4")
    return Result(rows(measured, _most_ms(vehicle)), as_json(measured, written), text(measured), {}, advice)


def _refuse_armed(link: LatencyLink, address: str) -> None:
    status = link.status()
    if status is not None and status.armed:
        raise DeviceError(f"autopilot {address}: expected a disarmed PX4, found it armed; land and disarm")


async def _tapped(
    link: LatencyLink, clock: Clock, poses: list[MocapPose], wanted: int, seconds: float
) -> tuple[TapDelay, ...]:
    """Every tap so far, until there are enough that count, or the time is over.

    While taps come they are only counted: whatever keeps the event loop busy would stamp motion capture late.
    """
    end_s, from_s = clock() + seconds, clock()
    done: list[TapDelay] = []
    missing = wanted
    while missing > 0 and clock() < end_s:
        felt = await _count(link, clock, from_s, end_s, missing)
        if not felt:
            break
        tell("enough; measuring")
        seen = [PoseSample(p.stamp_s, p.position_world_m, p.attitude_wxyz) for p in poses if p.tracking_valid]
        if len(seen) < _HISTORY_POSES_MIN:
            break
        noise, imu = mocap_noise(seen), link.imu()
        for tap in find_taps([sample for sample in imu if sample.t_s >= from_s - 1.0]):
            if from_s <= tap.t_s <= felt[-1].t_s + 0.1:
                near = [sample for sample in imu if abs(sample.t_s - tap.t_s) < 1.0]
                done.append(measure_tap(tap, near, [pose for pose in seen if abs(pose.t_s - tap.t_s) < 1.0], noise))
        missing = wanted - len(agreeing(done))
        from_s = clock() + _LOOK_S
        if missing > 0:
            tell(f"{missing} of {wanted} are missing, the last problem: {_last_problem(done)}; go on tapping")
    return tuple(done)


async def _count(link: LatencyLink, clock: Clock, from_s: float, end_s: float, wanted: int) -> list[Tap]:
    """Taps from then on, as soon as there are so many and all of the last one has arrived; fewer when the time is over."""
    felt: list[Tap] = []
    while clock() < end_s and (len(felt) < wanted or clock() < felt[-1].t_s + SETTLE_S):
        await asyncio.sleep(_LOOK_S)
        for tap in find_taps(link.imu(_WINDOW_S)):
            new = not felt or tap.t_s > felt[-1].t_s + APART_S
            if new and from_s <= tap.t_s < clock() - _LOOK_S:
                felt.append(tap)
                tell(f"  tap {len(felt)} of {wanted}: {tap.strength_m_s2:.1f} m/s2")
    return felt


def _last_problem(taps: list[TapDelay]) -> str:
    return next((tap.problem for tap in reversed(taps) if tap.problem), "their delays differ")


async def _about_link(link: LatencyLink, poses: list[MocapPose]) -> Measured:
    told = [pose.latency_s for pose in poses if pose.latency_s is not None]
    values = await link.read_params([PARAMETER])
    px4_ms = float(values[PARAMETER]) if PARAMETER in values else None
    latency_s = statistics.median(told) if told else None
    return Measured((), "", link.round_trip_s(), link.imu_age_s(), latency_s, px4_ms)


def _writable(total_ms: float, most_ms: float) -> bool:
    if 0.0 <= total_ms <= most_ms:
        return True
    tell(f"{PARAMETER} is not written: {total_ms:.1f} ms is outside of 0 to {most_ms:g} ms")
    return False


def _most_ms(vehicle: Vehicle) -> float:
    """The preflight refuses more."""
    limits = next(one.limits for one in WANTED if one.name == PARAMETER)
    return math.inf if limits is None else limits(vehicle)[1]


def rows(m: Measured, most_ms: float) -> list[Row]:
    """What it means for PX4."""
    if isinstance(m.delay, str):
        fix = (
            f"tap harder, with the flat of the hand ({STRENGTH_MIN_M_S2:g} m/s2 and more), the machine held up in the air where it can "
            "give way, markers in view, one tap a second"
        )
        return [TAPS.bad(m.delay, "", fix)]
    assert m.total_ms is not None
    found = [TAPS.good(f"{len(m.delay.used)} of {len(m.taps)}, {1e3 * m.delay.spread_s:.1f} ms from tap to tap")]
    value = round(m.total_ms, _DIGITS)
    read = f"measured {m.total_ms:.1f} +- {1e3 * m.delay.error_s:.1f} ms, PX4 has " + (
        f"{m.px4_ms:g} ms" if m.px4_ms is not None else "no such parameter"
    )
    if m.px4_ms is not None and abs(m.px4_ms - m.total_ms) <= TOLERANCE_MS:
        found.append(DELAY.good(read))
    else:
        fix = f"set {PARAMETER} to {value:g} (companion latency --write, or QGroundControl), restart PX4"
        found.append(DELAY.bad(read, f"within {TOLERANCE_MS:g} ms", fix))
    if m.total_ms > most_ms:
        fix = "take load off Motive (no video, fewer bodies), a cable to a network of its own; then measure again"
        found.append(LONG.bad(f"{m.total_ms:.1f} ms", f"at most {most_ms:g} ms", fix))
    else:
        found.append(LONG.good(f"{m.total_ms:.1f} ms", f"at most {most_ms:g} ms"))
    return found


def text(m: Measured) -> list[str]:
    """For people."""
    lines = [f"  tap  {'felt':>10}  {'delay':>9}  {'error':>8}  correlation"]
    for number, tap in enumerate(m.taps, start=1):
        error = f"{1e3 * tap.error_s:5.2f} ms" if math.isfinite(tap.error_s) else "       -"
        lines.append(
            f"  {number:<4} {tap.tap.strength_m_s2:5.1f} m/s2  {1e3 * tap.delay_s:6.2f} ms  {error}  {tap.correlation:.2f}"
            + (f"  {tap.problem}" if tap.problem else "")
        )
    parts = [f"mocap datagram's age by the server's stamps {_ms(m.mocap_latency_s)}"]
    parts.append(f"IMU message's age {_ms(m.imu_age_s)}")
    parts.append(f"link to PX4 and back {_ms(m.round_trip_s)}")
    lines.append("  " + ", ".join(parts))
    if not isinstance(m.delay, str) and m.total_ms is not None:
        lines.append(
            f"  exposure to companion {1e3 * m.delay.delay_s:.2f} ms, to PX4 {m.total_ms:.2f} ms, standard error "
            f"{1e3 * m.delay.error_s:.2f} ms"
        )
    return [*lines, ""]


def as_json(m: Measured, written_ms: float | None) -> dict[str, Any]:
    """For scripts; ms."""

    def ms(value_s: float | None) -> float | None:
        return None if value_s is None or not math.isfinite(value_s) else 1e3 * value_s

    known = not isinstance(m.delay, str)
    return {
        "ev_delay_ms": m.total_ms,
        "standard_error_ms": ms(m.delay.error_s) if not isinstance(m.delay, str) else None,
        "spread_ms": ms(m.delay.spread_s) if not isinstance(m.delay, str) else None,
        "to_companion_ms": ms(m.delay.delay_s) if not isinstance(m.delay, str) else None,
        "px4_ms": m.px4_ms,
        "written_ms": written_ms,
        "parameter": {PARAMETER: round(m.total_ms, _DIGITS)} if known and m.total_ms is not None else None,
        "mocap_latency_ms": ms(m.mocap_latency_s),
        "imu_age_ms": ms(m.imu_age_s),
        "round_trip_ms": ms(m.round_trip_s),
        "taps": [
            {
                "t_s": tap.tap.t_s,
                "strength_m_s2": tap.tap.strength_m_s2,
                "delay_ms": ms(tap.delay_s),
                "error_ms": ms(tap.error_s),
                "correlation": tap.correlation,
                "problem": tap.problem or None,
            }
            for tap in m.taps
        ],
    }


def _ms(value_s: float | None) -> str:
    return "not told" if value_s is None else f"{1e3 * value_s:.1f} ms"
