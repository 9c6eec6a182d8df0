"""Whole missions in the fast closed loop: the real core, stub, servos and world on simulated time."""

from __future__ import annotations

import math

import pytest

from companion.control.hover_thrust import AIRBORNE_M
from companion.model.frames import tilt_rad
from companion.model.types import OperatorCommand, Outcome, PhaseKind, Vec3
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from tests.flights.ends import after
from tests.support import SHORT_CATCH

pytestmark = pytest.mark.usefixtures("short_start")


def configured(*overrides: str, preset: str = "recommended") -> SitlConfig:
    return load_sitl("configs/missions/catch.yaml", preset=preset, overrides=overrides)


def short(*overrides: str) -> SitlConfig:
    """Take-off at 3.2 s, the line at 4.7 s, the catch at 5.7 s, landing from 7.7 s on."""
    return load_sitl(SHORT_CATCH, preset="recommended", overrides=overrides)


def event_ids(result: FastResult) -> list[str]:
    return [event.id for outputs in result.outputs for event in outputs.events]


def error_after_catch_m(result: FastResult) -> float:
    """RMS of the mocap position against the reference, from the catch to the landing."""
    squares = []
    caught = False
    for inputs, outputs in zip(result.inputs, result.outputs, strict=True):
        caught = caught or any(event.id == "catch" for event in outputs.events)
        if caught and outputs.phase_kind is PhaseKind.FLIGHT and outputs.reference and inputs.mocap:
            squares.append(math.dist(inputs.mocap.position_world_m, outputs.reference.position_world_m) ** 2)
    return math.sqrt(sum(squares) / len(squares))


@pytest.mark.parametrize(("preset", "limit_m"), [("recommended", 0.03), ("paper", 0.42)])
def test_the_payload_is_caught_where_the_paper_has_it_and_carried_home(preset: str, limit_m: float) -> None:
    """The law that users get flies to the end."""
    flight = FastFlight(configured("world.payload_kg=0.3", preset=preset))
    result = flight.run(until_mission_s=math.inf if preset == "recommended" else 11.0)
    assert result.caught
    assert event_ids(result)[:2] == ["takeoff", "catch"]
    assert error_after_catch_m(result) <= limit_m
    assert max(tilt_rad(truth.attitude_wxyz) for truth in result.truth) < math.radians(15)
    begun = next(o.t_s - o.mission_t_s for o in result.outputs if o.mission_t_s > 0)
    catch = next(e for o in result.outputs for e in o.events if e.id == "catch")
    assert catch.t_s - begun == pytest.approx(6.5, abs=0.15)
    at = min(result.truth, key=lambda truth: abs(truth.t_s - catch.t_s))
    assert at.position_world_m[0] == pytest.approx(0.0, abs=0.1 if preset == "recommended" else 0.5)
    if preset == "recommended":
        assert result.outputs[-1].outcome is Outcome.COMPLETED and event_ids(result)[2:] == ["touchdown"]
        x, y, _ = result.truth[-1].position_world_m
        assert math.hypot(x + 1.0, y) < 0.1, "it did not come home"
        assert_loads_stand_still_on_the_ground(result)


def assert_loads_stand_still_on_the_ground(result: FastResult) -> None:
    """The adaptive loads do not wind up while the ground carries the vehicle."""
    low_m = configured().vehicle.airframe.ground_clearance_m + AIRBORNE_M
    low = [
        outputs.control.load_estimate_n
        for inputs, outputs in zip(result.inputs, result.outputs, strict=True)
        if outputs.control and inputs.vehicle and inputs.vehicle.position_world_m[2] <= low_m
    ]
    assert low[0] == (0.0, 0.0, 0.0) != low[-1]
    assert len(low) > 100
    assert set(low) == {low[0], low[-1]}


def test_the_same_seed_flies_the_same_flight_bit_for_bit() -> None:
    first, again = (FastFlight(short()).run(limit_s=6.7) for _ in range(2))
    assert first.caught and again.outputs == first.outputs
    other = FastFlight(short("world.seed=2")).run(limit_s=2.0)
    assert other.outputs != first.outputs[: len(other.outputs)]


FOLDED_DEG = (165.0, 140.0)


def test_a_lost_device_lands_it() -> None:
    """After the catch. PX4's link: below; motion capture, and other times: tests/sitl/test_faults.py."""
    result = FastFlight(short("world.faults=[{kind: servo_loss, t_s: 4.2}]")).run()
    last, truth = result.outputs[-1], result.truth[-1]
    assert last.outcome is Outcome.ABORTED
    assert not result.crashed
    assert truth.position_world_m[2] < 0.35
    assert max(tilt_rad(t.attitude_wxyz) for t in result.truth) < math.radians(25)


def test_px4_whose_link_is_dead_finds_the_floor_by_its_barometer() -> None:
    """In take-off, in a laboratory whose IMU drifts sideways by more than PX4's land detector accepts."""
    lost = ("world.seed=2", "world.faults=[{kind: link_loss, phase: takeoff}]")
    flight = FastFlight(load_sitl("configs/missions/catch.yaml", overrides=lost, world="lab"))
    result = flight.run()
    assert result.outputs[-1].outcome is Outcome.ABORTED and not result.crashed
    assert not flight.px4.armed
    folded = [math.degrees(angle) for angle in result.truth[-1].joint_angle_rad]
    assert max(abs(a - b) for a, b in zip(folded, FOLDED_DEG, strict=True)) < 12
    assert max(tilt_rad(t.attitude_wxyz) for t in result.truth) < math.radians(25)


@pytest.mark.parametrize("axes", [(1, 2, -3), (3, 2, 1)], ids=lambda axes: "".join(map("{:+}".format, axes)))
def test_a_force_sensor_with_wrong_axes_is_reported_at_the_catch_and_not_used(axes: tuple[int, ...]) -> None:
    """The signs of its axes, or their order. The arm is unfolded: the payload's weight has a part along x and one along z."""
    flight = FastFlight(short())
    measure = flight.plant.force_torque

    def turned() -> tuple[Vec3, Vec3]:
        force_n, torque_nm = measure()
        x, y, z = (math.copysign(1.0, axis) * force_n[abs(axis) - 1] for axis in axes)
        return (x, y, z), torque_nm

    flight.plant.force_torque = turned  # type: ignore[method-assign]
    result = flight.run(until=after("force_disagrees", 0.1))
    assert result.caught
    assert event_ids(result) == ["takeoff", "force_disagrees"]
    last = result.outputs[-1].control
    assert last is not None and last.force_ext_world_n == (0.0, 0.0, 0.0), "the law still uses it"


def test_a_delay_that_makes_the_control_law_swing_is_reported_and_px4_lands() -> None:
    """Of the setpoints alone, so that nothing that arrives is late."""
    result = FastFlight(configured("world.setpoint_delay_s=0.11")).run()
    assert result.outputs[-1].outcome is Outcome.ABORTED
    assert event_ids(result)[:2] == ["takeoff", "oscillates"]
    assert not result.crashed
    assert max(tilt_rad(t.attitude_wxyz) for t in result.truth) < math.radians(25)


def test_asked_to_land_it_lands() -> None:
    """In take-off. Asked in a hold, and again while it lands: tests/core/test_verdict.py."""
    at_s = 4.2
    result = FastFlight(short(), {at_s: OperatorCommand.LAND}).run()
    assert result.outputs[-1].outcome is Outcome.ABORTED
    assert not result.crashed
    assert result.truth[-1].position_world_m[2] < 0.35
    assert result.outputs[-1].t_s < at_s + 9.0


@pytest.mark.parametrize(
    ("overrides", "why"),
    [
        (("mission.start.position_m=[-0.5, 0]",), "x"),
        (("vehicle.safety.battery_min=0.9", "world.battery_start=0.5"), "battery_low"),
    ],
)
def test_refused_on_the_ground(overrides: tuple[str, ...], why: str) -> None:
    if why == "x":
        # The world is built from the same mission, so the machine is moved after it was placed.
        flight = FastFlight(configured(*overrides))
        flight.plant.scene.data.qpos[0] = -1.0
    else:
        flight = FastFlight(configured(*overrides))
    result = flight.run()
    assert result.outputs[-1].outcome is Outcome.REFUSED
    assert max(t.position_world_m[2] for t in result.truth) < 0.32
    assert result.outputs[-1].mission_t_s == 0.0
