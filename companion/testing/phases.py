"""Checks of the contract of mission phases, which the author of a type of phase calls from their own tests."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from pathlib import Path

from companion.config.loader import FlightConfig, load_flight
from companion.control.arm_model import manipulator_of
from companion.control.manipulator import Manipulator
from companion.mission.air import Air, Expectation, Observation
from companion.mission.check import check_mission
from companion.mission.phase import Phase, phases_of
from companion.mission.plan import Plan
from companion.mission.segments import Segment
from companion.model.codec import Record, differences
from companion.model.constants import TICK_PERIOD_S
from companion.model.types import ForceSample, Inputs, OperatorCommand, Reference, Vec3
from companion.safety.governor import SafeSet
from companion.safety.notices import EventDefinition

TICKS = 2000
"""Most ticks for which a phase acts on random inputs."""
REST_M_S, BEFORE_END_S = 1e-3, 1e-6
"""Speed that counts as rest, and time before the end of a phase; the end itself belongs to the next one."""


def check_phases(mission: str | Path, vehicle: str | Path | None = None) -> None:
    """Check every phase of a mission.

    Its keys survive the log, its plan is the same every time and begins and ends at rest, and the mission passes the checks before
    take-off. A phase that acts gives the same states and reports for the same random inputs, and changes only what it may.

    Args:
        mission: mission file, or the name of a shipped one.
        vehicle: vehicle file, or the name of a shipped one; None for the mission's.

    Raises:
        AssertionError: a check fails; the text names the phase and what was found.
        ConfigError: the mission is invalid.
    """
    config = load_flight(mission, vehicle)
    plan, again = (Plan.build(config.mission, config.vehicle) for _ in range(2))
    phases = phases_of(config.mission)
    for segment, other in zip(plan.segments, again.segments, strict=True):
        phase = phases[segment.index]
        label = f"phases[{segment.index}], {phase.type}"
        assert type(phase).model_validate_json(phase.model_dump_json()) == phase, (
            f"{label}: its keys do not survive the log"
        )
        assert segment == other and segment.end_s >= segment.start_s, f"{label}: planned from {segment} to {other}"
        for t_s in (segment.start_s, segment.end_s - BEFORE_END_S):
            reference = plan.reference(t_s)
            found = differences(reference, again.reference(t_s))
            assert found is None, f"{label}: planned twice, {found} at t = {t_s:g} s"
            speed_m_s = math.hypot(*reference.velocity_world_m_s)
            assert speed_m_s < REST_M_S, f"{label}: plans {speed_m_s:.3f} m/s at t = {t_s:g} s, expected rest"
        if phase.acts:
            _check_acting(config, plan, phase, segment, label)
    problems = check_mission(config.mission, config.vehicle, phase_origins=config.sources.phases)
    assert not problems, f"companion fly refuses this mission: {'; '.join(problems)}"


def _check_acting(config: FlightConfig, plan: Plan, phase: Phase, segment: Segment, label: str) -> None:
    first, second = (_flown(config, plan, phase, segment, label) for _ in range(2))
    found = differences(first, second)
    assert found is None, f"{label}: the same inputs twice: {found}"


def _flown(config: FlightConfig, plan: Plan, phase: Phase, segment: Segment, label: str) -> tuple[object, ...]:
    """Return the states and the reports of a phase for random inputs, the same on every call."""
    history: list[object] = []
    own: Record | None = None
    manipulator, safe = manipulator_of(config.vehicle), SafeSet(config.vehicle)
    at_s = segment.start_s
    for k, observation in enumerate(_random_observations(plan, segment)):
        air = _Tick(config, plan, segment, observation, manipulator, safe, at_s)
        own = phase.begin(air) if k == 0 else phase.step(air, own)
        history += [own, *air.reports]
        if own is None:
            break
        assert isinstance(own, Record), f"{label}: its state is {type(own).__name__}, expected a Record"
        expected, reference = phase.expects(own), phase.reference(air.plan_reference(), own)
        assert isinstance(expected, Expectation), f"{label}: expects returns {type(expected).__name__}"
        values = (*reference.position_world_m, *reference.velocity_world_m_s, reference.yaw_rad, *reference.arm_rad)
        assert all(map(math.isfinite, values)), f"{label}: tick {k} of random inputs: its reference is not finite"
        history += [expected, reference]
        at_s = air.at_s + TICK_PERIOD_S
    return tuple(history)


def _random_observations(plan: Plan, segment: Segment) -> Iterator[Observation]:
    draw = random.Random(1)
    reference = plan.reference(segment.start_s)

    def three(most: float) -> Vec3:
        return (draw.uniform(-most, most), draw.uniform(-most, most), draw.uniform(-most, most))

    for tick in range(TICKS):
        t_s = segment.start_s + tick * TICK_PERIOD_S
        force = ForceSample(stamp_s=t_s, force_sensor_n=three(5.0), torque_sensor_nm=three(0.5), overload=False)
        yield Observation(
            inputs=Inputs(tick=tick, t_s=t_s, force=force, command=OperatorCommand.NONE, recorder_dropped=0),
            airborne=True,
            armed_by_others=False,
            standing=None,
            reference=reference,
            tether=None,
            thrust_share=1.0,
            pose_s=t_s,
            dt_s=TICK_PERIOD_S,
            force_world_n=three(5.0) if draw.random() < 0.9 else None,
            disturbance_world_n=three(5.0) if draw.random() < 0.9 else None,
            position_error_m=three(0.05),
            yaw_error_rad=draw.uniform(-0.05, 0.05),
        )


class _Tick(Air):
    """A tick in which the plan's time passes, unless the phase holds or moves it."""

    def __init__(
        self,
        config: FlightConfig,
        plan: Plan,
        engaged: Segment,
        observation: Observation,
        manipulator: Manipulator,
        safe: SafeSet,
        at_s: float,
    ) -> None:
        vehicle, mission, segment = config.vehicle, config.mission, plan.segment(at_s)
        phases, limits = phases_of(mission), mission.limits
        super().__init__(observation, vehicle, manipulator, phases, segment, engaged, limits, safe, True)
        self._plan = plan
        self.at_s = at_s
        self.reports: list[object] = []

    def plan_s(self) -> float:
        """Return the plan's time since the start of the phase."""
        return self.at_s - self.engaged.start_s

    def plan_reference(self) -> Reference:
        """Return the plan's reference at the plan's time."""
        return self._plan.reference(self.at_s)

    def report(self, notice: EventDefinition, text: str) -> None:
        """Record an event."""
        self.reports += [notice.id, text]

    def fail(self, notice: EventDefinition, text: str) -> None:
        """Record a failure."""
        self.report(notice, text)

    def resume(self, notice: EventDefinition, text: str) -> None:
        """Record the end of a hold."""
        self.report(notice, text)

    def stay(self, segment: Segment) -> None:
        """Keep the plan's time before the end of a segment."""
        self.at_s = min(self.at_s, segment.end_s - BEFORE_END_S)

    def move_to(self, plan_s: float) -> None:
        """Record the time, and move the plan's time to it."""
        self.reports.append(plan_s)
        self.at_s = plan_s
