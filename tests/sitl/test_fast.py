"""The fast closed loop: what it records of the world, its settings, and its clean-up."""

from __future__ import annotations

import gc
import json
import math

import pytest
from msgspec.structs import replace

from companion.control.types import PlantState, Wrench
from companion.model.outputs import Outputs
from companion.model.servos import WATCHDOG_ERROR
from companion.model.types import Inputs, Joints, MocapPose, Outcome, PhaseKind, Reference, SafetyAction, Severity
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.fast.guardian import FastGuardian
from sitl.fast.loop import FastFlight
from sitl.faults.timing import ARMED_SEEN_S
from tests.support import LOW_HOVER, ROOT

LOW = tuple(f"{key}={value}" for key, value in LOW_HOVER.items())


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    """A flight with faults that is ended in the air is not followed to the floor."""
    monkeypatch.setattr("sitl.fast.loop.SETTLE_S", 0.0)


def configured(*overrides: str) -> SitlConfig:
    return load_sitl("configs/missions/hover.yaml", overrides=("world.payload_kg=0", *LOW, *overrides))


def test_the_truth_that_is_made_afterwards_is_the_one_of_the_tick() -> None:
    flight = FastFlight(configured())
    seen = []
    step = flight.core.step

    def watched(inputs):  # type: ignore[no-untyped-def]
        seen.append(flight.plant.truth)
        return step(inputs)

    flight.core.step = watched  # type: ignore[method-assign]
    result = flight.run(limit_s=4.0)
    assert len(seen) == len(result.inputs) > 600
    assert result.truth == seen
    assert result.truth is result.truth, "made once"


def test_answers_that_come_10_ms_late_do_not_make_the_arm_swing() -> None:
    late = "world.faults=[{kind: bus_delay, after: start, t_s: 0.6, size: 0.01}]"
    config = load_sitl("configs/missions/catch.yaml", world="lab", overrides=("world.seed=2003", late))
    result = FastFlight(config).run(9.6)
    ages_s = [i.t_s - i.arm.measured_s for i in result.inputs[-200:] if i.arm is not None]
    assert all(0.0099 < age_s < 0.0201 for age_s in ages_s)
    events = [event.id for o in result.outputs for event in o.events if event.id.startswith("joint_")]
    assert events == ["joint_states_late"]


def test_an_arm_that_swings_because_answers_are_12_ms_late_is_calmed_before_it_meets_its_limits() -> None:
    late = "world.faults=[{kind: bus_delay, t_s: 2.3, size: 0.012}]"
    result = FastFlight(load_sitl("configs/missions/catch.yaml", world="lab", overrides=("world.seed=1", late))).run(
        11.5
    )
    events = [event.id for o in result.outputs for event in o.events if event.id.startswith("joint_")]
    assert events == ["joint_states_late", "joint_swings"]
    rates = [max(map(abs, i.arm.velocity_rad_s)) for i in result.inputs if i.arm is not None and i.t_s > 10.4]
    assert max(rates) < 2.5, "the mission turns the arm by up to 2 rad/s"


def test_answers_that_hardly_come_at_all_are_reported_once() -> None:
    late = "world.faults=[{kind: bus_delay, t_s: 2.3, size: 0.08}]"
    result = FastFlight(load_sitl("configs/missions/catch.yaml", world="lab", overrides=("world.seed=2", late))).run(
        9.0
    )
    events = [event.id for o in result.outputs for event in o.events if event.severity is not Severity.INFO]
    assert sorted(events) == ["gate", "joint_states_late"]


def test_a_silent_servo_lets_go_and_that_is_reported_when_it_answers_again() -> None:
    """As over the wire: the watchdog trips, and the driver restarts it and reports it in one state."""
    result = FastFlight(configured("world.faults=[{kind: servo_loss, t_s: 3.5, duration_s: 0.12}]")).run()
    armed_s = next(i.t_s for i in result.inputs if i.status is not None and i.status.armed)
    reported_s = [i.t_s - armed_s for i in result.inputs if i.arm is not None and i.arm.hardware_error != (0, 0)]
    assert reported_s == [pytest.approx(3.62 - ARMED_SEEN_S, abs=0.011)] * len(reported_s)
    assert len({i.arm.stamp_s for i in result.inputs if i.arm is not None and any(i.arm.hardware_error)}) == 1
    errors = {i.arm.hardware_error for i in result.inputs if i.arm is not None}
    assert errors == {(0, 0), (WATCHDOG_ERROR, 0)}
    back = next(i for i in result.inputs if i.arm is not None and any(i.arm.hardware_error))
    assert back.arm is not None and back.arm.torque_nm[0] == 0.0
    assert any(event.id == "servo_watchdog_tripped" for o in result.outputs for event in o.events)


def test_a_law_whose_torques_stay_unusable_is_landed_by_px4_with_the_arm_folded() -> None:
    """From 1 s after take-off on the law's joint torques are unusable, and the arm is limp; a single such tick does no harm. Too few of
    them: tests/safety/test_joint_counts.py.
    """
    torques_nm: Joints = (float("nan"), 0.1)
    flight = FastFlight(configured())
    law, ticks = flight.core._control._controller, 0
    step = law.step

    def with_unusable_torques(dt_s: float, state: PlantState, reference: Reference, vertical_scale: float) -> Wrench:
        nonlocal ticks
        wrench, ticks = step(dt_s, state, reference, vertical_scale), ticks + (vertical_scale >= 1.0)
        return replace(wrench, arm_torque_nm=torques_nm) if ticks in (100, 110) or ticks > 200 else wrench

    law.step = with_unusable_torques  # type: ignore[method-assign]
    result = flight.run()
    events = [(o.t_s, event) for o in result.outputs for event in o.events]
    assert [event.id for _, event in events].count("torque_refused") == 1
    at_s, event = next(found for found in events if found[1].id == "torque_refused")
    refused_s = [o.t_s for o in result.outputs if o.arm_torque_nm is None and o.phase_kind is not PhaseKind.GROUND]
    assert event.action is SafetyAction.AUTOPILOT_LAND and "joint torque (nan, 0.1) is not finite" in event.text
    assert at_s - refused_s[2] == pytest.approx(0.1, abs=0.02), "the two single ticks did not count"
    assert not result.crashed and not result.armed and result.outputs[-1].outcome is Outcome.ABORTED
    fold_deg = flight.config.vehicle.fold_arm_deg
    assert result.inputs[-1].arm is not None
    assert [math.degrees(angle) for angle in result.inputs[-1].arm.angle_rad] == pytest.approx(fold_deg, abs=5.0)


def test_a_vehicle_that_px4_lands_with_a_drifting_estimate_is_stopped_when_it_stands() -> None:
    """Poses freeze after the take-off. The estimate sinks 0.35 m/s too fast, and on the floor it continues at half of its speed; PX4
    would raise the vehicle again (laboratory 9337 of docs/internals/tune.md).
    """
    faults = json.dumps([{"kind": "mocap_freeze", "t_s": 5.8}])
    overrides = [f"world.faults={faults}", "world.seed=9337", "world.payload_kg=0", "mission.repeat=1"]
    overrides += ["mission.limits.speed_max_m_s=0.8"]  # as it was flown when this laboratory was found
    config = load_sitl(ROOT / "configs/missions/circuit.yaml", preset="recommended", overrides=overrides, world="lab")
    result = FastFlight(config).run(12.8)
    events = {event.id: event for outputs in result.outputs for event in outputs.events}
    assert events["mocap_frozen"].action is SafetyAction.AUTOPILOT_LAND
    landed_s = events["autopilot_landing"].t_s
    assert landed_s < 12.7
    floor_m = config.vehicle.airframe.ground_clearance_m
    heights_m = [s.q[2] for o, s in zip(result.outputs, result.snapshots, strict=True) if o.t_s >= landed_s]
    assert max(heights_m) < floor_m + 0.02
    assert result.outputs[-1].attitude is not None and result.outputs[-1].attitude.thrust == 0.0


@pytest.mark.parametrize("on", [True, False])
def test_the_garbage_collector_is_left_as_it_was(on: bool) -> None:
    was_on = gc.isenabled()
    try:
        (gc.enable if on else gc.disable)()
        FastFlight(configured()).run(limit_s=0.1)
        assert gc.isenabled() is on
    finally:
        (gc.enable if was_on else gc.disable)()


def test_the_guardian_learns_the_servers_clock_in_standby() -> None:
    """Poses that are late from the takeover on are refused, as by the guardian of a flight, also without the server's echoes."""
    sent: list[float] = []
    for standby_s in (0.0, 1.0):
        flight = FastFlight(configured())
        guardian = FastGuardian(flight.config.flight.vehicle, flight.px4)
        guardian.heartbeat(*_first_tick(flight))
        for k in range(round(standby_s / 0.01)):
            guardian.see(_pose(0.01 * k, delay_s=0.0))
        landing = guardian.take_over(2.0)
        before = flight.px4.vision_received
        for k in range(10):
            landing.step(2.0 + 0.01 * k, [_pose(2.0 + 0.01 * k, delay_s=0.3)])
        sent.append(flight.px4.vision_received - before)
    assert sent == [10, 0]


def _first_tick(flight: FastFlight) -> tuple[Inputs, Outputs]:
    result = flight.run(0.1)
    return result.inputs[0], result.outputs[0]


def _pose(t_s: float, *, delay_s: float) -> MocapPose:
    """A pose without a latency that ends at its arrival, from a server whose clock is 5000 s ahead."""
    return MocapPose(
        stamp_s=t_s,
        latency_s=0.0,
        frame_number=round(100.0 * t_s),
        position_world_m=(0.0, 0.0, 1.0 + 1e-4 * t_s),
        attitude_wxyz=(1.0, 0.0, 0.0, 0.0),
        tracking_valid=True,
        marker_error_m=0.0,
        exposure_server_s=5000.0 + t_s - delay_s,
    )
