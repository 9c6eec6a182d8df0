"""Faults in the simulated world: when they act, what they do, and how a flight with one of them ends."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest

from companion.campaigns.faults.judge import good
from companion.campaigns.runner import Row
from companion.config.document import ConfigError
from companion.mission.plan import Plan
from companion.model.flight_stage import SPOOL_S
from companion.model.frames import attitude_ned_frd_from_enu_flu
from companion.model.types import Event, Outcome, Quat, SafetyAction, Vec3
from companion.safety.stop import StopModel
from companion.sitl_config.faults import KINDS, FaultKind, FlightPhase
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.campaigns.faults import fly
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from sitl.faults.timing import FaultError, with_fault_times
from tests.support import CATCH, HOVER, ROOT, SHORT_CATCH

pytestmark = pytest.mark.usefixtures("short_start")

INTERCEPT = ROOT / "configs/missions/intercept.yaml"
CONFIG = load_sitl(CATCH, preset="recommended")
LINE_M_S = 0.74
"""The line of the catch, in its middle."""
SHORT = load_sitl(SHORT_CATCH, preset="recommended")


def with_faults(*faults: dict[str, Any], mission: Any = CATCH, world: str = "world.seed=1") -> SitlConfig:
    return load_sitl(mission, overrides=[f"world.faults={json.dumps(list(faults))}", world])


def flown(kind: FaultKind, phase: FlightPhase, size: float | None = None, config: SitlConfig = SHORT) -> Row:
    row: Row = fly(config, {"kind": kind, "size": size, "duration_s": None, "phase": phase})["row"]
    return row


def fault_and_events(config: SitlConfig) -> tuple[float, FastFlight, FastResult, dict[str, Event]]:
    """Fly; return when the fault began, and the first event of each kind since then."""
    flight = FastFlight(config)
    result = flight.run()
    begun_s = flight.faults.begun_s
    assert begun_s is not None
    events = [event for outputs in result.outputs for event in outputs.events if event.t_s >= begun_s]
    return begun_s, flight, result, {event.id: event for event in reversed(events)}


def assert_lands_near(result: FastResult, begun_s: float) -> None:
    """It lands, within 0.6 m of where it was when the fault began."""
    assert not result.crashed and not result.armed
    at_fault = next(truth for truth in result.truth if truth.t_s >= begun_s)
    assert math.dist(at_fault.position_world_m[:2], result.truth[-1].position_world_m[:2]) < 0.6


def test_a_phase_is_a_time_of_the_plan() -> None:
    plan = Plan.build(CONFIG.mission, CONFIG.vehicle)
    expected: dict[FlightPhase, str] = {"takeoff": "take-off", "line": "catch", "return": "return", "landing": "land"}
    for phase, name in expected.items():
        (fault,) = with_fault_times(with_faults({"kind": "mocap_loss", "phase": phase})).world.faults
        assert fault.t_s is not None
        assert fault.after == "arming"
        assert plan.segment(fault.t_s - SPOOL_S).name == name, phase


def test_a_mission_without_a_way_back_has_no_such_phase() -> None:
    with pytest.raises(FaultError, match="mission 'hover' has no phase 'return'; give t_s instead"):
        with_fault_times(with_faults({"kind": "mocap_loss", "phase": "return"}, mission=HOVER))


@pytest.mark.parametrize(
    ("fault", "problem"),
    [
        ({"kind": "mocap_loss", "t_s": 1.0, "phase": "line"}, "give either t_s or phase"),
        ({"kind": "mocap_loss", "t_s": 1.0, "size": 2.0}, "a mocap_loss has no size"),
        ({"kind": "gust", "t_s": 1.0, "size": -2.0}, "must not be negative"),
        ({"kind": "bus_noise", "t_s": 1.0, "size": 2.0}, "is a fraction, 0 to 1"),
        ({"kind": "mocap_rate", "t_s": 1.0, "size": 0.0}, "must be above 0"),
    ],
)
def test_a_fault_that_means_nothing_is_refused(fault: dict[str, Any], problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        with_faults(fault)


def test_a_fault_of_a_part_that_vehicle_or_world_do_not_have_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"world\.faults\[0\]\.servo: .* has 2 servos, got servo 3"):
        with_faults({"kind": "servo_loss", "t_s": 1.0, "servo": 3})
    with pytest.raises(ConfigError, match=r"surface_gone needs world\.surfaces, but the world has none"):
        with_faults({"kind": "surface_gone", "t_s": 1.0})


def test_faults_that_are_over_leave_the_world_as_it_was() -> None:
    over = [{"kind": kind, "after": "start", "t_s": 0.0, "duration_s": 0.4} for kind in KINDS if kind not in _FOR_GOOD]
    flight = FastFlight(with_faults(*over))
    machine, drives = flight.plant.machine, [servo.drive for servo in flight.plant._servos]
    while flight.plant.t_s < 0.2:
        flight.plant.step(False)
    assert len(flight.faults.active) == len(over)
    assert machine.rotor_share is not None and machine.tether.snag is not None and machine.wind_m_s != (0.0, 0.0, 0.0)
    while flight.plant.t_s < 0.6:
        flight.plant.step(False)
    assert flight.faults.active == {}
    assert machine.rotor_share is None and machine.tether.snag is None
    assert machine.wind_m_s == pytest.approx((0.0, 0.0, 0.0))
    assert machine.tether.length_m == CONFIG.vehicle.tether.length_m
    assert flight.plant.scene.payload.aside_m == 0.0
    assert not flight.px4.refuses_offboard and not flight.px4.refuses_arming
    assert flight.faults.sag_v == 0.0
    assert [drive.slip_counts for drive in drives] == [0, 0]
    assert flight.faults.server_clock_s(1.0) == 1.0
    assert flight.faults.pose((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0)) == ((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0), True)
    assert flight.faults.wrench((1.0, 2.0, 3.0), (4.0, 5.0, 6.0)) == ((1.0, 2.0, 3.0), (4.0, 5.0, 6.0))


_FOR_GOOD = (
    "autopilot_reboot",
    "servo_overload",
    "clamp_overload",
    "payload_double",
    "payload_dropped",
    "payload_heavy",
    "pilot_takeover",
    "surface_gone",
    "surface_slippery",
    "tool_broken",
)


def test_of_two_of_a_kind_the_other_one_goes_on() -> None:
    first = {"kind": "mocap_jump", "after": "start", "t_s": 0.0, "duration_s": 0.2, "size": 0.5}
    second = {"kind": "mocap_jump", "after": "start", "t_s": 0.1, "duration_s": 0.3, "size": 1.0}
    flight = FastFlight(with_faults(first, second))
    sizes = []
    while flight.plant.t_s < 0.5:
        flight.plant.step(False)
        sizes.append((flight.plant.t_s, flight.faults.size("mocap_jump")))
    assert {size for t_s, size in sizes if 0.11 < t_s < 0.39} == {1.0}
    assert {size for t_s, size in sizes if t_s > 0.41} == {0.0}


def test_a_short_fault_whose_catch_is_known_late_lasts_as_long_as_it_should() -> None:
    flight = FastFlight(with_faults({"kind": "mocap_loss", "after": "catch", "t_s": 0.05, "duration_s": 0.1}))
    acts = []
    while flight.plant.t_s < 0.5:
        flight.plant.step(False)
        if flight.plant.t_s > 0.3:
            flight.plant.scene.payload.caught_t_s = 0.0
        acts.append((flight.plant.t_s, "mocap_loss" in flight.faults.active))
    assert {on for t_s, on in acts if 0.31 < t_s < 0.39} == {True}
    assert {on for t_s, on in acts if t_s < 0.3 or t_s > 0.41} == {False}


def test_a_clock_that_steps_makes_the_frames_late_that_were_on_their_way() -> None:
    """Exposed by the old clock, sent by the new one; those after them are as they were."""
    config = with_faults({"kind": "clock_step", "after": "start", "t_s": 0.503, "size": 5.0})
    result = FastFlight(config).run(1.0)
    poses = {i.mocap.frame_number: i.mocap for i in result.inputs if i.mocap is not None}
    late = [pose for pose in poses.values() if pose.latency_s is not None and pose.latency_s > 1.0]
    assert 1 <= len(late) <= 2
    assert all(pose.latency_s == pytest.approx(5.0, abs=0.02) for pose in late)
    assert poses[max(poses)].latency_s == pytest.approx(0.005, abs=0.003)


def test_without_faults_the_flight_is_the_same_to_the_last_bit() -> None:
    late = FastFlight(with_faults({"kind": "mocap_loss", "t_s": 1000.0})).run(3.0)
    never = FastFlight(CONFIG).run(3.0)
    assert [o.attitude for o in late.outputs] == [o.attitude for o in never.outputs]
    assert [s.q for s in late.snapshots] == [s.q for s in never.snapshots]


@pytest.mark.parametrize(
    ("kind", "phase", "size", "end"),
    [
        ("mocap_latency", "line", 0.2, ("landed", "mocap_lost", "autopilot_land")),
        ("link_delay", "line", 0.08, ("landed", "link_late", "autopilot_land")),
        ("offboard_refused", "landing", None, ("landed", "offboard_left", "autopilot_land")),
        ("arming_refused", "ground", None, ("refused", "arming_refused", "nominal")),
        ("servo_overload", "line", None, ("landed", "servo_error", "land")),
        ("servo_angle", "line", 40.0, ("landed", "joint_jump", "land")),
    ],
)  # fmt: skip
def test_it_ends_well_and_is_reported(
    kind: FaultKind, phase: FlightPhase, size: float | None, end: tuple[str, ...]
) -> None:
    row = flown(kind, phase, size)
    assert good(row), row["problems"]
    assert (row["outcome"], row["event"], row["action"]) == end, row["events"]


def test_a_flight_with_four_faults_that_only_warn_and_a_gap_shorter_than_the_timeout_completes() -> None:
    faults = (
        {"kind": "bus_noise", "phase": "takeoff", "size": 0.6},
        {"kind": "mocap_loss", "phase": "takeoff", "duration_s": 0.1},
        {"kind": "stall_loop", "phase": "line", "duration_s": 0.06},
        {"kind": "force_stuck", "phase": "line"},
        {"kind": "kill_recorder", "phase": "landing"},
    )
    _, _, result, events = fault_and_events(with_faults(*faults, mission=SHORT_CATCH))
    warned = {name for name, event in events.items() if event.action is not SafetyAction.NOMINAL}
    assert warned >= {"arm_read_failures", "loop_late", "force_stuck", "recorder_drops"}
    assert not any(name.startswith("mocap") for name in warned)
    assert {o.action for o in result.outputs} == {SafetyAction.NOMINAL, SafetyAction.WARN}
    assert result.outputs[-1].outcome is Outcome.COMPLETED and not result.crashed and not result.armed


def test_a_tether_that_holds_it_brings_it_down() -> None:
    row = flown("tether_snag", "line", 0.05, config=CONFIG)
    assert good(row), row["problems"]
    assert row["outcome"] == "landed"
    assert {"tether_taut", "tether_snagged"} & set(row["events"])


class Received:
    """What PX4 receives of motion capture in a fast flight."""

    def __init__(self, flight: FastFlight) -> None:
        self.off_m: list[float] = []
        self.turned_deg: list[float] = []
        self._flight, self._on_vision = flight, flight.px4.on_vision
        flight.px4.on_vision = self.on_vision  # type: ignore[method-assign]

    def on_vision(self, t_s: float, position_ned_m: Vec3, attitude_ned_frd: Quat) -> bool:
        x, y, z, *attitude = self._flight.plant.machine.q[0:7]
        if self._flight.plant.armed_t_s is not None:
            north, east, down = position_ned_m
            self.off_m.append(math.dist((east, north, -down), (x, y, z)))
            true = attitude_ned_frd_from_enu_flu((attitude[0], attitude[1], attitude[2], attitude[3]))
            same = abs(sum(a * b for a, b in zip(true, attitude_ned_frd, strict=True)))
            self.turned_deg.append(math.degrees(2.0 * math.acos(min(1.0, same))))
        return self._on_vision(t_s, position_ned_m, attitude_ned_frd)


def test_of_a_body_that_flickers_px4_gets_the_good_poses_and_no_bad_one() -> None:
    """Frames that start no tick: each was forwarded on the verdict of the one before it, so PX4 got the bad ones."""
    mocap = "world.mocap={on: true, delivery_jitter_s: 0.004, pivot_offset_m: [0, 0, 0], body_yaw_deg: 0, "
    mocap += "body_tilt_deg: [0, 0], lost_share: 0, wobble_m: 0, wobble_deg: 0}"
    config = load_sitl(SHORT_CATCH, overrides=["world.faults=[{kind: mocap_flip, phase: takeoff}]", mocap])
    flight = FastFlight(config)
    received = Received(flight)
    result = flight.run()
    assert result.outputs[-1].outcome is Outcome.COMPLETED
    assert {event.id for o in result.outputs for event in o.events if event.action is SafetyAction.WARN} == {
        "mocap_jump"
    }
    assert max(received.off_m) < 0.1 and max(received.turned_deg) < 10.0
    assert len(received.off_m) > 0.4 * 200.0 * 0.7 * result.outputs[-1].mission_t_s


def test_the_guardian_passes_on_none_of_the_bad_poses_either() -> None:
    faults = [{"kind": "mocap_flip", "phase": "line"}, {"kind": "kill_flight", "phase": "line"}]
    flight = FastFlight(with_faults(*faults, mission=SHORT_CATCH))
    received = Received(flight)
    result = flight.run()
    assert result.guardian_landed and not result.crashed
    assert max(received.turned_deg) < 10.0


def test_a_delay_behind_the_servers_stamp_is_reported_and_ends_well() -> None:
    """At 0.18 s the vehicle was lost, and no event named the cause."""
    row = flown("mocap_network", "line", 0.18)
    assert row["event"] == "mocap_too_late" and row["detected_s"] < 0.43
    assert good(row) and row["drift_m"] < 0.6


def test_after_a_gap_another_bodys_pose_does_not_reach_px4_which_lands_without_it() -> None:
    """PX4 would reset its position to the first pose: this flight ended 4 m away, on its tether (laboratory 1)."""
    faults = ({"kind": "mocap_loss", "duration_s": 1.5}, {"kind": "mocap_swap", "size": 0.8})
    on_the_line = json.dumps([{**fault, "phase": "line"} for fault in faults])
    config = load_sitl(SHORT_CATCH, overrides=[f"world.faults={on_the_line}"], world="lab")
    begun_s, _, result, events = fault_and_events(config)
    assert "mocap_swapped" in events
    assert_lands_near(result, begun_s)


def test_poses_lost_on_the_line_end_in_a_landing_and_after_the_gap_the_vehicles_own_are_used_again() -> None:
    gap_s, safety = 2.0, CONFIG.vehicle.safety
    begun_s, _, result, events = fault_and_events(
        with_faults({"kind": "mocap_loss", "phase": "line", "duration_s": gap_s}, mission=SHORT_CATCH)
    )
    assert events["mocap_lost"].t_s - begun_s <= safety.mocap_timeout_s + 0.03
    back = [o.mocap_trusted for o in result.outputs if o.t_s > begun_s + gap_s + 0.1]
    assert back and all(back)
    at_fault = next(truth for truth in result.truth if truth.t_s >= begun_s)
    drift_m = max(
        math.dist(at_fault.position_world_m[:2], t.position_world_m[:2]) for t in result.truth if t.t_s >= begun_s
    )
    assert drift_m <= StopModel(safety).distance_m(LINE_M_S)
    assert not result.crashed and not result.armed


def test_hung_in_the_chase_of_a_ball_px4_1_18_stops_it_within_half_a_metre() -> None:
    """LAND of PX4 1.18 begins with the acceleration of the chase: with MPC_JERK_AUTO 6 it flew on for 2.5 m."""
    hang = json.dumps([{"kind": "stop_flight", "after": "throw", "t_s": 0.4}])
    settings = [f"world.faults={hang}", 'world.px4_version="1.18"', "world.seed=1"]
    begun_s, _, result, _ = fault_and_events(load_sitl(INTERCEPT, overrides=settings, world="careless"))
    assert result.layout is not None and result.guardian_landed
    moves = [
        truth.position_world_m[:2]
        for truth in (*result.truth, *map(result.layout.truth, result.after))
        if truth.t_s >= begun_s
    ]
    assert max(math.dist(moves[0], position) for position in moves) < 0.5


def test_a_second_payload_is_carried_too_and_one_that_is_dropped_is_felt_no_more() -> None:
    second = {"kind": "payload_double", "after": "catch", "t_s": 0.2, "size": 0.2}
    dropped = {"kind": "payload_dropped", "after": "catch", "t_s": 1.2}
    begun_s, _, result, _ = fault_and_events(with_faults(second, dropped, mission=SHORT_CATCH))
    assert result.outputs[-1].outcome is Outcome.COMPLETED and not result.crashed
    assert {o.action for o in result.outputs} == {SafetyAction.NOMINAL}
    assert _load_n(result, begun_s + 0.7) == pytest.approx(0.4 * 9.81, abs=0.6)
    assert _load_n(result, begun_s + 2.0) == pytest.approx(0.2 * 9.81, abs=0.5)


def _load_n(result: FastResult, t_s: float) -> float:
    """What hangs in the net, by the force sensor, over a quarter of a second."""
    loads = [
        -o.control.force_ext_world_n[2] for o in result.outputs if o.control is not None and t_s <= o.t_s < t_s + 0.25
    ]
    return sum(loads) / len(loads)


def test_a_restart_of_px4_in_the_air_is_a_fall_and_is_called_so() -> None:
    row = flown("autopilot_reboot", "line", 2.0)
    assert row["outcome"] == "crashed"
    assert row["problems"] == ["crashed"]
    assert row["event"] == "vehicle_state_lost"
