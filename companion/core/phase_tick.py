"""Flies the phases that have a state of their own in the air (`companion.mission.phase`): one tick. Pure."""

from __future__ import annotations

import math
from pathlib import Path

from companion.core.transition import Transition
from companion.mission.active_plan import ActiveTrajectory
from companion.mission.air import NOTHING, Air, Expectation
from companion.mission.phase import Phase
from companion.mission.segments import Segment
from companion.model.codec import R, Record, RecordError, from_packet, to_packet
from companion.model.types import Outcome, Reference, SafetyAction
from companion.plugins import one_line
from companion.safety import rules
from companion.safety.notices import EventDefinition
from companion.safety.supervisor import SupervisorState

_BEFORE_END_S = 1e-6
_OF_JOINTS = frozenset({"arm_rad", "arm_rate_rad_s", "arm_acceleration_rad_s2"})


class PhaseFailed(Exception):
    """The code of a phase raised an exception; the text names the phase, the exception and its place."""


def failed(phase: Phase, error: Exception) -> PhaseFailed:
    """Return the error of a phase that raised `error`."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    in_phase = trace is not None and not isinstance(error, RecordError)
    place = (
        f" ({Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno})" if in_phase and trace is not None else ""
    )
    return PhaseFailed(f"phase '{phase.title}' failed: {one_line(error)}{place}")


def checked(cls: type[R], returned: object) -> R:
    """Return what a phase has returned, as a record of this class.

    Raises:
        RecordError, TypeError, ValueError, OverflowError: it is none.
    """
    record: R = from_packet(cls, to_packet(returned))
    return record


def checked_reference(returned: object, joints: int) -> Reference:
    """Return what a phase has returned, as a reference with finite values for an arm of so many joints.

    Raises:
        RecordError, TypeError, ValueError, OverflowError: it is none.
    """
    reference = checked(Reference, returned)
    for name in Reference.__struct_fields__:
        value = getattr(reference, name)
        values = value if isinstance(value, tuple) else () if value is None else (value,)
        if not all(map(math.isfinite, values)):
            raise RecordError(f"reference() returned {name} {value}, expected finite values")
        if name in _OF_JOINTS and len(values) != joints:
            raise RecordError(f"reference() returned {name} of {len(values)} joints, expected {joints}")
    return reference


def advance_phase(t: Transition) -> None:
    """Advance the phase at the plan's time by one tick; called in every tick of a mission with a phase that acts.

    Raises:
        PhaseFailed: a phase, perhaps of another package, raised an exception.
    """
    if t.o.phase_error is not None:
        raise PhaseFailed(t.o.phase_error)
    engaged = t.state.engaged if t.state.own is not None else None
    try:
        _advance(t)
    except Exception as error:
        assert t.state.course is not None
        raise failed(_phase_of(t, engaged or t.state.course.segment(t.i.t_s)), error) from error


def _advance(t: Transition) -> None:
    state, t_s = t.state, t.i.t_s
    course = state.course
    assert course is not None
    segment = course.segment(t_s)
    phase: Phase = t.parameters.phases[segment.index]
    if state.own is None:
        if not phase.acts:
            if state.skips:
                t.change(skips=False)
            return
        begun = None if state.skips else phase.begin(_PhaseTick(t, segment, segment))
        if begun is None:
            t.change(course=course.moved_to(segment.end_s, t_s))
        else:
            _fly(t, phase, begun, segment)
        return
    engaged = state.engaged
    assert engaged is not None
    tick = _PhaseTick(t, segment, engaged)
    own = _phase_of(t, engaged).step(tick, state.own)
    if own is None:
        _end(t, engaged, tick.skips_rest)
    else:
        _fly(t, _phase_of(t, tick.engaged), own, tick.engaged)


def leave(t: Transition) -> None:
    """Leave what the phase does, because the flight is to hold.

    Raises:
        PhaseFailed: as in `advance_phase`.
    """
    own, engaged = t.state.own, t.state.engaged
    if own is None or engaged is None:
        return
    phase = _phase_of(t, engaged)
    try:
        left = phase.leave(own, t.i.t_s)
    except Exception as error:
        raise failed(phase, error) from error
    if left is None:
        t.change(own=None, skips=True, expected=NOTHING)
    else:
        _fly(t, phase, left, engaged)


def _phase_of(t: Transition, segment: Segment) -> Phase:
    phase: Phase = t.parameters.phases[segment.index]
    return phase


def _fly(t: Transition, phase: Phase, own: Record, engaged: Segment) -> None:
    expected: object = phase.expects(own)
    if not isinstance(expected, Expectation):
        raise RecordError(f"expects() returned {type(expected).__name__}, no Expectation")
    t.change(own=own, engaged=engaged, expected=expected)
    if expected.clamp is not None:
        t.change(clamp=expected.clamp, grip=expected.grip, bar=expected.bar)


def _end(t: Transition, engaged: Segment, skips: bool) -> None:
    """End the phase. If it ended early, those that go on with its state are skipped."""
    course, t_s = t.state.course, t.i.t_s
    assert course is not None
    if course.held and t.state.supervisor.action is not SafetyAction.HOLD:
        course = course.resume(t_s)
    if not skips:
        course = course.moved_to(engaged.end_s, t_s)
    t.change(own=None, skips=skips, expected=NOTHING, course=course)


class _PhaseTick(Air):
    """One tick of a phase, as part of a transition."""

    def __init__(self, t: Transition, segment: Segment, engaged: Segment) -> None:
        p = t.parameters
        action = t.state.supervisor.action
        nominal, holds = action is SafetyAction.NOMINAL, action.rank >= SafetyAction.HOLD.rank
        limits, waits = (
            p.config.mission.limits,
            t.state.supervisor.cause == rules.PARTNER_HOLDS and t.o.standing is None,
        )
        super().__init__(
            t.o, p.vehicle, p.manipulator, p.phases, segment, engaged, limits, p.safe, nominal, holds, waits
        )
        self._t = t

    @property
    def _course(self) -> ActiveTrajectory:
        course = self._t.state.course
        assert course is not None
        return course

    def plan_s(self) -> float:
        """Return the plan's time since the start of the phase whose state it is."""
        return self._course.pace(self.t_s)[0] - self.engaged.start_s

    def plan_reference(self) -> Reference:
        """Return the plan's reference, without what the phase adds."""
        return self._course.reference(self.t_s)

    def report(self, notice: EventDefinition, text: str) -> None:
        """Add an event."""
        self._t.report(notice, text)

    def fail(self, notice: EventDefinition, text: str) -> None:
        """Report a failure: the flight counts as aborted, and the plan's time stops until the state ends."""
        self._t.report(notice, text)
        self._t.finish(Outcome.ABORTED)
        self._t.change(course=self._course.hold(self.t_s))

    def resume(self, notice: EventDefinition, text: str) -> None:
        """End the hold and report it. The phase calls this only after the operator has resumed each vehicle that began a hold."""
        self._t.report(notice, text)
        self._t.change(supervisor=SupervisorState(SafetyAction.NOMINAL, notice.id, self.t_s))
        self._t.change(course=self._course.resume(self.t_s))
        self._t.resumed = True
        self.holds = self.waits = False

    def stay(self, segment: Segment) -> None:
        """Keep the plan's time before the end of a segment."""
        course, last_s = self._course, segment.end_s - _BEFORE_END_S
        if not course.held and course.pace(self.t_s)[0] >= last_s:
            self.move_to(last_s)

    def move_to(self, plan_s: float) -> None:
        """Move the plan's time to a start or an end of a segment, where the plan is at rest, or to any place of it during a hold."""
        self._t.change(course=self._course.moved_to(plan_s, self.t_s))
