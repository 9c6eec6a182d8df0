"""`companion latency`: measures the delay of motion capture to PX4 by taps on the airframe, and sets EKF2_EV_DELAY."""

from __future__ import annotations

import asyncio
import math
import statistics
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from companion.commissioning.latency.fit import (
    APART_S,
    SETTLE_S,
    STRENGTH_MIN_M_S2,
    Delay,
    Tap,
    TapDelay,
    agreeing,
    combine,
    find_taps,
    measure_tap,
    mocap_noise,
)
from companion.commissioning.tool import SENSORS, Report, Session, Tool
from companion.config.vehicle import Vehicle
from companion.io.protocols import DeviceError
from companion.model.check_row import Row
from companion.model.types import MocapPose
from companion.preflight.checks import Check
from companion.preflight.hand_test.motion import PoseAt
from companion.px4.required import WANTED
from companion.runtime.clock import Clock, flight_clock
from companion.runtime.realtime import FLIGHT_PRIORITY, claim_realtime

if TYPE_CHECKING:
    from companion.commissioning.latency.link import LatencyLink

PARAMETER: Final = "EKF2_EV_DELAY"
TOLERANCE_MS: Final = 3.0
_LOOK_S: Final = 0.5
_WINDOW_S: Final = 3.0
_HISTORY_POSES_MIN: Final = 50
_DIGITS: Final = 1
"""Decimal places of a delay in ms."""

DEVICES = Check("latency.devices", "PX4 and motion capture", why="both are needed for the comparison")
TAPS = Check("latency.taps", "taps", why="the delay remains unknown")
DELAY = Check(
    "latency.delay",
    "EKF2_EV_DELAY",
    why="PX4 fuses each pose at the wrong time: the estimate oscillates with the vehicle's motion",
)
LONG = Check(
    "latency.long",
    "delay of motion capture",
    why="the filter lags by this time, and every loop that depends on it becomes slower",
)


@dataclass(frozen=True, slots=True)
class Measured:
    """All taps of a session, and the delays of the links."""

    taps: tuple[TapDelay, ...]
    delay: Delay | str
    """Delay from exposure to the companion, or the reason why there is none."""
    round_trip_s: float
    imu_age_s: float | None
    mocap_latency_s: float | None
    """Median time from mid-exposure to transmission, according to the server's stamps."""
    px4_ms: float | None
    """Current EKF2_EV_DELAY; None if PX4 has no such parameter."""
    written_ms: float | None = None
    """Written EKF2_EV_DELAY; None if it was not written."""

    @property
    def total_ms(self) -> float | None:
        """Time from exposure to arrival in PX4, as in EKF2_EV_DELAY; None if the delay is unknown."""
        return None if isinstance(self.delay, str) else 1e3 * (self.delay.delay_s + 0.5 * self.round_trip_s)


async def measure(session: Session) -> Measured:
    """Open motion capture and PX4, wait for the taps, and write the parameter on request."""
    from companion.commissioning.latency.link import LatencyLink  # imports MAVSDK
    from companion.io.mocap.driver import MocapDriver

    arguments, vehicle = session.arguments, session.vehicle
    clock, devices = flight_clock(), vehicle.devices
    poses: list[MocapPose] = []
    async with MocapDriver(devices.mocap, clock, poses.append), LatencyLink(devices.autopilot, clock) as link:
        _refuse_armed(link, devices.autopilot.address)
        # As in flight, because a busy computer stamps motion capture late.
        claim_realtime(FLIGHT_PRIORITY, cpus=vehicle.computer.cpus, lock_memory=False)
        session.say(
            f"hold the vehicle up by its legs, propellers off, while a second person taps its frame {arguments.taps} times with "
            "the flat of the hand, one tap a second, from several sides"
        )
        taps = await _tapped(session, link, clock, poses)
        latencies_s = [pose.latency_s for pose in poses if pose.latency_s is not None]
        measured = Measured(
            taps=taps,
            delay=combine(taps),
            round_trip_s=link.round_trip_s(),
            imu_age_s=link.imu_age_s(),
            mocap_latency_s=statistics.median(latencies_s) if latencies_s else None,
            px4_ms=(await link.read_params([PARAMETER])).get(PARAMETER),
        )
        if not arguments.write or measured.total_ms is None:
            return measured
        value, max_ms = round(measured.total_ms, _DIGITS), _max_ms(vehicle)
        if not arguments.yes:
            session.show(judge(measured, vehicle))
        if not 0.0 <= measured.total_ms <= max_ms:
            session.say(f"{PARAMETER} is not written: {measured.total_ms:.1f} ms is outside 0 to {max_ms:g} ms")
        elif session.confirm(f"write {PARAMETER} = {value:g} ms to PX4?"):
            _refuse_armed(link, devices.autopilot.address)
            measured = replace(measured, written_ms=float(await link.write_param(PARAMETER, value)))
        return measured


def _refuse_armed(link: LatencyLink, address: str) -> None:
    status = link.status()
    if status is not None and status.armed:
        raise DeviceError(f"autopilot {address}: expected a disarmed PX4, but it is armed; land and disarm")


async def _tapped(session: Session, link: LatencyLink, clock: Clock, poses: list[MocapPose]) -> tuple[TapDelay, ...]:
    """Return all taps once enough are usable or time is up; meanwhile only count: computing would delay mocap's stamps."""
    end_s, from_s, wanted = clock() + session.arguments.seconds, clock(), session.arguments.taps
    done: list[TapDelay] = []
    missing = wanted
    while missing > 0 and clock() < end_s:
        felt = await _count(session, link, clock, from_s, end_s, missing)
        if not felt:
            break
        session.say("enough taps; measuring")
        seen = [PoseAt(p.stamp_s, p.position_world_m, p.attitude_wxyz) for p in poses if p.tracking_valid]
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
            problem = next((tap.problem for tap in reversed(done) if tap.problem), "their delays differ")
            session.say(f"{missing} of {wanted} taps are missing (last problem: {problem}); continue tapping")
    return tuple(done)


async def _count(
    session: Session, link: LatencyLink, clock: Clock, from_s: float, end_s: float, wanted: int
) -> list[Tap]:
    """Return the taps since `from_s` once there are `wanted` of them and the last is complete; fewer if time runs out."""
    felt: list[Tap] = []
    while clock() < end_s and (len(felt) < wanted or clock() < felt[-1].t_s + SETTLE_S):
        await asyncio.sleep(_LOOK_S)
        for tap in find_taps(link.imu(_WINDOW_S)):
            new = not felt or tap.t_s > felt[-1].t_s + APART_S
            if new and from_s <= tap.t_s < clock() - _LOOK_S:
                felt.append(tap)
                session.say(f"  tap {len(felt)} of {wanted}: {tap.strength_m_s2:.1f} m/s2")
    return felt


def _max_ms(vehicle: Vehicle) -> float:
    limits = next(one.limits_for(vehicle) for one in WANTED if one.name == PARAMETER)
    return math.inf if limits is None else limits[1]


def judge(m: Measured, vehicle: Vehicle) -> Report:
    """Compare the measured delay with PX4's parameter and with the preflight's limit."""
    advice = []
    if m.written_ms is not None:
        advice.append(f"{PARAMETER} = {m.written_ms:g} ms was written to PX4 (before: {m.px4_ms} ms); restart PX4")
    return Report(rows(m, _max_ms(vehicle)), as_json(m), text(m), advice=advice)


def rows(m: Measured, max_ms: float) -> list[Row]:
    """Return the rows; `max_ms` is the largest delay that the preflight accepts."""
    if isinstance(m.delay, str):
        fix = (
            f"tap harder, with the flat of the hand ({STRENGTH_MIN_M_S2:g} m/s2 or more), one tap a second; hold the vehicle in "
            "the air so that it can move, with its markers in view"
        )
        return [TAPS.bad(m.delay, "", fix)]
    assert m.total_ms is not None
    has = "no such parameter" if m.px4_ms is None else f"{m.px4_ms:g} ms"
    right = m.px4_ms is not None and abs(m.px4_ms - m.total_ms) <= TOLERANCE_MS
    set_it = f"set {PARAMETER} to {round(m.total_ms, _DIGITS):g} (companion latency --write, or QGroundControl), then restart PX4"
    relieve = (
        "reduce Motive's load (no video, fewer bodies) and connect by cable on a separate network; then measure again"
    )
    return [
        TAPS.good(f"{len(m.delay.used)} of {len(m.taps)}, {1e3 * m.delay.spread_s:.1f} ms from tap to tap"),
        DELAY.row(
            right,
            f"measured {m.total_ms:.1f} +- {1e3 * m.delay.error_s:.1f} ms; PX4 has {has}",
            f"within {TOLERANCE_MS:g} ms",
            set_it,
        ),
        LONG.row(m.total_ms <= max_ms, f"{m.total_ms:.1f} ms", f"at most {max_ms:g} ms", relieve),
    ]


def text(m: Measured) -> list[str]:
    """Return the table of taps and the sum of the delays, for display."""
    lines = [f"  tap  {'strength':>10}  {'delay':>9}  {'error':>8}  correlation"]
    for number, tap in enumerate(m.taps, start=1):
        error = f"{1e3 * tap.error_s:5.2f} ms" if math.isfinite(tap.error_s) else "       -"
        lines.append(
            f"  {number:<4} {tap.tap.strength_m_s2:5.1f} m/s2  {1e3 * tap.delay_s:6.2f} ms  {error}  {tap.correlation:.2f}"
            + (f"  {tap.problem}" if tap.problem else "")
        )
    ages = (
        ("mocap datagram's age (server's stamps)", m.mocap_latency_s),
        ("IMU message's age", m.imu_age_s),
        ("link to PX4 and back", m.round_trip_s),
    )
    lines.append("  " + ", ".join(f"{name} {'unknown' if s is None else f'{1e3 * s:.1f} ms'}" for name, s in ages))
    if not isinstance(m.delay, str):
        lines.append(
            f"  exposure to companion {1e3 * m.delay.delay_s:.2f} ms, to PX4 {m.total_ms:.2f} ms, standard error "
            f"{1e3 * m.delay.error_s:.2f} ms"
        )
    return [*lines, ""]


def as_json(m: Measured) -> dict[str, Any]:
    """Return the measurement's part of the JSON document; ms."""

    def ms(value_s: float | None) -> float | None:
        return None if value_s is None or not math.isfinite(value_s) else 1e3 * value_s

    delay = None if isinstance(m.delay, str) else m.delay
    return {
        "ev_delay_ms": m.total_ms,
        "standard_error_ms": ms(delay.error_s) if delay else None,
        "spread_ms": ms(delay.spread_s) if delay else None,
        "to_companion_ms": ms(delay.delay_s) if delay else None,
        "px4_ms": m.px4_ms,
        "written_ms": m.written_ms,
        "parameter": None if m.total_ms is None else {PARAMETER: round(m.total_ms, _DIGITS)},
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


TOOLS: Final = {
    "latency": Tool(
        name="latency",
        family=SENSORS,
        collect=measure,
        fit=judge,
        device=DEVICES,
        no_data={"ev_delay_ms": None, "taps": []},
    )
}
