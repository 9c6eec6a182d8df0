"""Stream and event messages built from the ticks of a flight. Pure: time is an argument.

``e_p`` is defined as in `companion.analysis.metrics`: the pose minus the reference at the time at which the pose was measured.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Iterable
from typing import TypeVar

import msgspec

from companion.config.loader import FlightConfig
from companion.config.vehicle import OBSERVER
from companion.ground.protocol.messages import (
    EVENTS_KEPT,
    VERSION,
    BallView,
    BarView,
    ContactView,
    ControlView,
    EventLine,
    Events,
    Stream,
    TetherView,
    Timing,
)
from companion.ground.protocol.strict_json import NUMBER_MAX
from companion.ground.telemetry.health import HealthEvaluator, Snapshot, WorstAges
from companion.ground.telemetry.timings import WorstTimings, merge_timings
from companion.model.constants import GRADED_POSE_MAX_AGE_S, TICK_PERIOD_S
from companion.model.contact import ContactState
from companion.model.flight_stage import Stage
from companion.model.markers import BallState
from companion.model.outputs import ControlLog, Outputs, Sent, TetherState
from companion.model.team import BarPose
from companion.model.types import Inputs, Quat, Reference, SafetyAction, Vec3

STREAM_PERIOD_S = 0.05
"""Period of the stream messages over MQTT, and of those of a replayed flight."""
_REPLAYED_EVENTS = 2000
"""Number of newest events of a replayed flight to keep."""
_TOUCHDOWN = Stage.TOUCHDOWN.value
"""Phase after touchdown, in which a reference below the floor is not a tracking error."""
WAITS_FOR_START = Stage.READY.value
"""`Outputs.phase` of a flight that is ready and waits for START."""
TEXT_MAX = 300
"""Maximum number of characters in an event's text, so that `EVENTS_KEPT` events always fit into one message."""
_TEXT_MAX_BYTES = 1600
"""`TEXT_MAX` as a limit on the JSON text, in which a character may take twelve bytes."""
_HEALTH_WINDOW_S = 1.0
"""Length of the time window whose worst values the health shows, so that a problem in a single tick is visible."""

T = TypeVar("T", bound=tuple[float, ...])


class StreamBuilder:
    """Processes every tick, builds `Stream` messages on request, and keeps the newest events."""

    def __init__(self, config: FlightConfig, session: str) -> None:
        self._session = session
        self._health = HealthEvaluator(config.vehicle)
        self._has_force = config.vehicle.devices.force is not None or config.vehicle.force_source == OBSERVER
        self._newest: tuple[Inputs, Outputs, Sent] | None = None
        self._ages = WorstAges()
        self._worst = WorstTimings()
        self._past: deque[tuple[float, WorstAges]] = deque()
        self._frames_s: deque[float] = deque()
        self._first_frame_s: float | None = None
        self._missed = 0
        self._seq = 0
        self.events: deque[EventLine] = deque(maxlen=EVENTS_KEPT)
        self.count = 0

    @property
    def newest_outputs(self) -> Outputs | None:
        """Outputs of the newest tick."""
        return self._newest[1] if self._newest is not None else None

    def add_tick(self, inputs: Inputs, outputs: Outputs, sent: Sent) -> None:
        """Add the next tick."""
        before = self._newest
        self._newest = (inputs, outputs, sent)
        self._ages.add_tick(inputs, sent.lateness_s)
        self._missed += sent.lateness_s > TICK_PERIOD_S
        mocap = inputs.mocap
        fresh = mocap is not None and (
            before is None or before[0].mocap is None or before[0].mocap.stamp_s != mocap.stamp_s
        )
        if mocap is not None and fresh:
            if self._first_frame_s is None:
                self._first_frame_s = mocap.stamp_s
            self._frames_s.append(mocap.stamp_s)
        self._worst.add_tick(inputs, sent)
        for event in outputs.events:
            self._append(
                EventLine.of(msgspec.structs.replace(event, text=truncated(event.text)), outputs.mission_time_s(event))
            )

    def add_line(self, t_s: float, severity: str, source: str, text: str, *, replace_last: bool = False) -> None:
        """Add a line from a source other than the core: PX4, the guardian or the telemetry.

        Args:
            severity: value of `companion.model.types.Severity`.
            source: sender, used as the line's id.
            text: cut to `TEXT_MAX` characters.
            replace_last: replace the last line of the same source, so that repetitions do not displace other lines.
        """
        mission_t_s = self._newest[1].mission_t_s if self._newest is not None else 0.0
        if replace_last:
            kept = [line for line in self.events if line.id != source]
            self.events.clear()
            self.events.extend(kept)
        action = SafetyAction.NOMINAL.value
        self._append(
            EventLine(
                t_s=t_s, mission_t_s=mission_t_s, id=source, severity=severity, action=action, text=truncated(text)
            )
        )

    def events_message(self) -> Events:
        """Return the stored events."""
        return Events(v=VERSION, session=self._session, count=self.count, lines=tuple(map(_finite_line, self.events)))

    def build(self, wall_s: float, *, dropped: int = 0, recorder_error: str | None = None) -> Stream:
        """Return the current stream message, with the worst timings since the previous one.

        Args:
            wall_s: seconds since 1970.
            recorder_error: why recording stopped, or None.

        Raises:
            LookupError: no tick has been added.
        """
        if self._newest is None:
            raise LookupError("no tick yet")
        i, o, sent = self._newest
        lost = max(dropped, i.recorder_dropped)
        ages = self._ages_of_the_last_second(i.t_s)
        snapshot = Snapshot(
            inputs=i,
            outputs=o,
            ages=ages,
            mocap_rate_hz=self._mocap_rate_hz(i.t_s),
            missed=self._missed,
            dropped=lost,
            recorder_error=recorder_error,
        )
        timing = self._worst.message(self._missed, lost)
        self._ages = WorstAges()
        self._seq += 1
        pose_from, position, attitude, age_s = _pose(i, o)
        reference, status = o.reference, i.status
        setpoint = o.attitude
        return Stream(
            v=VERSION,
            session=self._session,
            seq=self._seq,
            wall_s=round(wall_s, 3),
            t_s=_number(i.t_s, 4) or 0.0,
            mission_t_s=_number(o.mission_t_s, 4) or 0.0,
            phase=o.phase,
            kind=o.phase_kind.value,
            progress=_number(o.progress, 5) or 0.0,
            action=o.action.value,
            hold=sent.hold,
            armed=status.armed if status is not None else None,
            mode=status.mode.value if status is not None else None,
            landed=status.landed.value if status is not None else None,
            pose_from=pose_from,
            position_world_m=_rounded(position, 4),
            attitude_wxyz=_rounded(attitude, 5),
            velocity_world_m_s=_rounded(i.vehicle.velocity_world_m_s, 4) if i.vehicle is not None else None,
            arm_rad=_rounded(i.arm.angle_rad, 5) if i.arm is not None else None,
            reference_world_m=_rounded(reference.position_world_m, 4) if reference is not None else None,
            reference_yaw_rad=_number(reference.yaw_rad, 5) if reference is not None else None,
            reference_arm_rad=_rounded(reference.arm_rad, 5) if reference is not None else None,
            e_p_m=None if o.phase == _TOUCHDOWN else _number(_position_error_m(position, age_s, reference), 5),
            e_q_deg=_number(_angle_deg(attitude, setpoint.attitude_wxyz), 4) if setpoint is not None else None,
            thrust=_number(setpoint.thrust, 5) if setpoint is not None else None,
            battery_v=_number(status.battery_voltage_v, 3) if status is not None else None,
            battery_remaining=_number(status.battery_remaining, 4) if status is not None else None,
            tether=_tether(o.tether),
            control=_control(o.control, self._has_force),
            contact=_contact(o.contact),
            ball=_ball(o.ball, i.t_s),
            bar=_bar(i.bar, i.t_s),
            timing=timing,
            lights=self._health.evaluate(snapshot),
            limited_by=o.limited_by,
            proofs=(),
            waits_for_start=o.phase == WAITS_FOR_START,
        )

    def _append(self, line: EventLine) -> None:
        self.events.append(line)
        self.count += 1

    def _ages_of_the_last_second(self, t_s: float) -> WorstAges:
        past = self._past
        past.append((t_s, self._ages))
        while past[0][0] < t_s - _HEALTH_WINDOW_S:
            past.popleft()
        worst = WorstAges()
        for _, ages in past:
            worst.merge(ages)
        return worst

    def _mocap_rate_hz(self, t_s: float) -> float | None:
        frames, first_s = self._frames_s, self._first_frame_s
        while frames and not frames[0] >= t_s - 1.0:
            frames.popleft()
        return float(len(frames)) if first_s is not None and t_s - first_s > 1.0 else None


def replay(
    rows: Iterable[tuple[Inputs, Outputs, Sent]],
    config: FlightConfig,
    session: str,
    epoch_offset_s: float,
    max_records: int = 12000,
) -> tuple[list[Stream], Events]:
    """Return a logged flight as the messages that the vehicle would have published.

    Args:
        rows: ticks in order, such as `companion.analysis.log.FlightLog.rows()` returns.
        epoch_offset_s: wall clock when the flight clock was zero.
        max_records: maximum number of messages, at least 2.

    Returns:
        Messages in order, including the first and the last tick, and the events of the flight.
    """
    maker = StreamBuilder(config, session)
    maker.events = deque(maxlen=_REPLAYED_EVENTS)
    period_s = STREAM_PERIOD_S
    records: list[Stream] = []
    due_s = -math.inf
    pending_s: float | None = None
    for inputs, outputs, sent in rows:
        maker.add_tick(inputs, outputs, sent)
        pending_s = inputs.t_s
        if not inputs.t_s < due_s - 1e-6:
            due_s = due_s + period_s if due_s + period_s > inputs.t_s else inputs.t_s + period_s
            records.append(maker.build(epoch_offset_s + inputs.t_s))
            pending_s = None
            if len(records) >= max_records:
                records = _every_second(records)
                period_s *= 2.0
                due_s = inputs.t_s + period_s
    if pending_s is not None:
        records.append(maker.build(epoch_offset_s + pending_s))
    return records, maker.events_message()


def _every_second(records: list[Stream]) -> list[Stream]:
    """Return every second message, including the first and the last, with the worst timings of those left out."""
    kept = [records[0]]
    between: list[Timing] = []
    for index, record in enumerate(records[1:], 1):
        if index % 2 and index != len(records) - 1:
            between.append(record.timing)
            continue
        kept.append(msgspec.structs.replace(record, timing=merge_timings([*between, record.timing])))
        between = []
    return kept


def _pose(i: Inputs, o: Outputs) -> tuple[str | None, Vec3 | None, Quat | None, float]:
    """Return the source, position, attitude and age (s) of the vehicle's pose."""
    mocap = i.mocap
    if (
        mocap is not None
        and mocap.tracking_valid
        and o.mocap_trusted
        and i.t_s - mocap.stamp_s <= GRADED_POSE_MAX_AGE_S
    ):
        age_s = i.t_s - mocap.stamp_s + (mocap.latency_s or 0.0)
        return "mocap", mocap.position_world_m, mocap.attitude_wxyz, age_s
    if i.vehicle is not None:
        v = i.vehicle
        return "px4", v.position_world_m, v.attitude_wxyz, i.t_s - v.position_stamp_s
    return None, None, None, 0.0


def _position_error_m(position: Vec3 | None, age_s: float, reference: Reference | None) -> float | None:
    if position is None or reference is None:
        return None
    at, speed = reference.position_world_m, reference.velocity_world_m_s
    return math.dist(position, [p - age_s * v for p, v in zip(at, speed, strict=True)])


def _angle_deg(a: Quat | None, b: Quat) -> float | None:
    if a is None:
        return None
    cos_half = abs(sum(x * y for x, y in zip(a, b, strict=True)))
    return math.degrees(2.0 * math.acos(min(1.0, cos_half))) if math.isfinite(cos_half) else None


def _tether(state: TetherState | None) -> TetherView | None:
    if state is None:
        return None
    numbers = _rounded((state.slack_m, state.stop_slack_m, state.pull_n, state.turns), 4)
    if numbers is None:
        return None
    slack_m, stop_slack_m, pull_n, turns = numbers
    return TetherView(
        slack_m=slack_m, stop_slack_m=stop_slack_m, pull_n=pull_n, turns=turns, taut=state.taut, snagged=state.snagged
    )


def _control(control: ControlLog | None, has_force: bool) -> ControlView | None:
    if control is None:
        return None
    h_hat, tau = _rounded(control.h_hat, 5), _rounded(control.tau, 4)
    force = _rounded(control.force_ext_world_n, 4)
    single = _rounded((control.rho, control.hover_thrust), 5)
    if h_hat is None or tau is None or force is None or single is None:
        return None
    return ControlView(
        rho=single[0],
        h_hat=h_hat,
        tau=(tau[0], tau[1], tau[2]),
        arm_torque_nm=tau[6:],
        force_ext_world_n=force if has_force else None,
        hover_thrust=single[1],
        saturated=any(control.saturated),
        payload_estimate_kg=_number(control.payload_estimate_kg, 4),
    )


def _contact(contact: ContactState | None) -> ContactView | None:
    numbers = None if contact is None else _rounded((contact.force_n, contact.wanted_n), 3)
    if contact is None or numbers is None:
        return None
    return ContactView(mode=contact.mode.value, force_n=numbers[0], wanted_n=numbers[1])


def _ball(ball: BallState | None, t_s: float) -> BallView | None:
    position = None if ball is None else _rounded(ball.position_world_m, 3)
    if ball is None or position is None:
        return None
    meeting = None if ball.meeting_world_m is None else _rounded(ball.meeting_world_m, 3)
    meets_in_s = None if ball.meeting_s is None else _number(max(0.0, ball.meeting_s - t_s), 3)
    return BallView(position_world_m=position, meeting_world_m=meeting, meets_in_s=meets_in_s)


def _bar(bar: BarPose | None, t_s: float) -> BarView | None:
    if bar is None or not bar.tracking_valid or not t_s - bar.stamp_s <= GRADED_POSE_MAX_AGE_S:
        return None
    position, attitude = _rounded(bar.position_world_m, 4), _rounded(bar.attitude_wxyz, 5)
    return None if position is None or attitude is None else BarView(position_world_m=position, attitude_wxyz=attitude)


def truncated(text: str) -> str:
    """Return the text cut to the size that a message allows."""
    text = text[:TEXT_MAX]
    return text if len(json.dumps(text)) <= _TEXT_MAX_BYTES else text[: _TEXT_MAX_BYTES // 12]


def _finite_line(line: EventLine) -> EventLine:
    if _fits(line.t_s) and _fits(line.mission_t_s):
        return line
    return msgspec.structs.replace(
        line, t_s=_number(line.t_s, 4) or 0.0, mission_t_s=_number(line.mission_t_s, 4) or 0.0
    )


def _fits(value: float) -> bool:
    """Whether a message may hold the number; False for NaN."""
    return abs(value) <= NUMBER_MAX


def _number(value: float | None, digits: int) -> float | None:
    return round(value, digits) if value is not None and _fits(value) else None


def _rounded(values: T | None, digits: int) -> T | None:
    if values is None or not all(map(_fits, values)):
        return None
    return type(values)(round(value, digits) for value in values)
