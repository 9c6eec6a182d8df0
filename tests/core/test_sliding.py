"""A slide along a surface in the fast loop: force and path, a tool that is caught, and what the check refuses."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from companion.analysis.contact import contact_lines, contact_summary
from companion.analysis.contact_plots import contact_force
from companion.control import slide as control
from companion.control.arm_model import manipulator_of
from companion.core.flight_core import FlightCore
from companion.mission.check import check_mission
from companion.model.contact import ContactMode
from companion.model.frames import euler_zyx_from_quat
from companion.model.outputs import Outputs
from companion.model.types import Joints, Vec3
from companion.phases.contact.force import touches
from companion.phases.contact.sliding import STEER_MAX_RAD, UNSEEN_MAX_N
from companion.sitl_config.loader import load_sitl
from sitl.campaigns.flights import row_of
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from tests.control.states import ZERO, at, at_rest
from tests.flights.ends import after, contact_over, flown_until

pytestmark = pytest.mark.usefixtures("short_start")

SLIDE = "configs/missions/slide.yaml"
ARM: Joints = (1.1, 1.4)
"""The arm stretched forward."""
NAN: Vec3 = (math.nan, math.nan, math.nan)
BROKEN: dict[int, tuple[str, dict[str, Any]]] = {
    0: ("vehicle", {"specific_force_body_m_s2": NAN, "delta_velocity_body_m_s": NAN}),
    20: ("mocap", {"position_world_m": NAN}),
    40: ("arm", {"angle_rad": NAN[:2]}),
    60: ("arm", {"velocity_rad_s": NAN[:2]}),
}
"""Ticks with NaN in the record from which the force on the vehicle, the place of the tip, or the arm's joint angles and rates come."""


def short_slide(friction: float) -> list[str]:
    """Return the overrides of a short slide, with little of a way to the wall and back."""
    wall = {"point_m": [1.5, 0.0, 0.54], "normal": [-1.0, 0.0, 0.0], "stiffness_n_m": 1e4, "friction": friction}
    return [
        f"world.surfaces={json.dumps([wall])}",
        "mission.start.position_m=[0.4,0.0]",
        "mission.phases[0]={type: takeoff, height_m: 0.8, duration_s: 2.0}",
        "mission.phases[1].duration_s=0.1",
        "mission.phases[2].to_m=[0.72,0.0,0.8]",
        "mission.phases[3]={type: approach, direction: [1.0, 0.0, 0.0], distance_max_m: 0.25, speed_m_s: 0.05}",
        "mission.phases[4]={type: slide, force_n: 3.0, displacement_m: [0.0, -0.2], speed_m_s: 0.08}",
        "mission.phases[6].to_m=[0.5,0.0,0.8]",
    ]


def slide(friction: float, *more: str, until: Callable[[Outputs], bool] | None = None) -> tuple[FastFlight, FastResult]:
    """Fly a short slide in the ideal world."""
    flight = FastFlight(load_sitl(SLIDE, world="ideal", overrides=[*short_slide(friction), *more]))
    return flight, flight.run(until=until)


@pytest.fixture(scope="module")
def slid() -> tuple[FastFlight, FastResult]:
    return slide(0.5, until=lambda o: o.phase == "detach")


def test_the_tip_follows_its_path_while_the_force_is_held(slid: tuple[FastFlight, FastResult]) -> None:
    flight, result = slid
    assert not result.crashed and result.layout is not None
    assert [e.id for o in result.outputs for e in o.events] == ["takeoff", "touched"]
    sliding = np.array([o.contact is not None and o.contact.mode is ContactMode.SLIDE for o in result.outputs])
    tips, forces = zip(*(result.layout.contact(s.sensors) for s in result.snapshots), strict=True)
    tip, force_n = np.array(tips)[sliding], -np.array(forces)[sliding, 0]
    assert tip[-1][2] - tip[0][2] == pytest.approx(-0.2, abs=0.02) and np.ptp(tip[:, 1]) < 0.01
    assert np.sqrt(np.mean((force_n - 3.0) ** 2)) < 0.45
    log = row_of(flight.config.flight, result, None)[1]
    summary = contact_summary(log)
    assert summary is not None and summary["path_rms_m"] < 0.018
    assert ("slide", "0.20 m along the surface") in contact_lines({"contact": summary})
    drawn = contact_force(log)
    assert drawn is not None
    sensor, corrected, wanted = drawn.axes[0].get_lines()
    labels = [sensor.get_label(), corrected.get_label(), wanted.get_label()]
    assert labels == ["sensor", "with the correction from the vehicle's motion", "wanted"]
    corrected_n = np.asarray(corrected.get_ydata())
    assert corrected_n[sliding].mean() == pytest.approx(summary["mean_n"])
    assert np.isnan(corrected_n[: np.flatnonzero(sliding)[0]]).all()  # before the slide there is only the sensor's


def test_values_that_are_not_finite_neither_steer_nor_press_and_a_wrong_force_is_still_found(
    slid: tuple[FastFlight, FastResult],
) -> None:
    flight, result = slid
    sliding = [k for k, o in enumerate(result.outputs) if o.contact is not None and o.contact.mode is ContactMode.SLIDE]
    first, core, seen = sliding[300], FlightCore(flight.config.flight), []
    for k, i in enumerate(result.inputs[: first + 300]):
        if k >= first + 200:  # the sensor measures 5 N less than acts
            assert i.force is not None
            x, y, z = i.force.force_sensor_n
            i = replace(i, force=replace(i.force, force_sensor_n=(x + 5.0, y, z)))
        if k - first in BROKEN:
            name, broken = BROKEN[k - first]
            i = replace(i, **{name: replace(getattr(i, name), **broken)})
        o = core.step(i)
        assert o == result.outputs[k] or k >= first, "replay"
        seen += [event.id for event in o.events]
        a, b = o.contact, result.outputs[k].contact
        if first <= k < first + 200:
            assert a is not None and b is not None and a.mode is ContactMode.SLIDE
            assert a.push_n == pytest.approx(b.push_n, abs=0.1) and a.unseen_n == pytest.approx(b.unseen_n, abs=0.1)
            assert a.steer_rad == pytest.approx(b.steer_rad, abs=0.05)
            assert a.disagreement_n == pytest.approx(b.disagreement_n, abs=0.3)
            assert a.unopposed_n == pytest.approx(b.unopposed_n, abs=0.3)
    assert {"vehicle_not_finite", "mocap_not_finite", "arm_not_finite"} < set(seen) and seen[-1] == "contact_disagrees"


def test_a_reading_across_the_tool_that_no_friction_explains_is_no_tether(slid: tuple[FastFlight, FastResult]) -> None:
    flight, result = slid
    first = next(k for k, o in enumerate(result.outputs) if o.contact is not None and o.contact.slide_world_n[2] < -1.0)
    core, seen = FlightCore(flight.config.flight), []
    for k, i in enumerate(result.inputs[: first + 500]):
        if k >= first:
            assert i.force is not None
            x, y, z = i.force.force_sensor_n
            i = replace(i, force=replace(i.force, force_sensor_n=(x, y + 4.0, z)))
        seen += [event.id for event in core.step(i).events]
    assert seen == ["takeoff", "touched"]


def test_a_tether_that_jams_in_a_slide_is_noticed_before_the_tip_has_lost_the_wall() -> None:
    jams = "world.faults=[{kind: tether_taut, t_s: 10.0, size: 0.0}]"
    above = "vehicle.tether.anchor_world_m=[0.4,0.0,1.65]"  # on the way down the distance grows
    flight = FastFlight(
        load_sitl(
            SLIDE,
            world="ideal",
            overrides=[*short_slide(0.5), "mission.phases[4].displacement_m=[0.0,-0.25]", above, jams],
        )
    )
    result = flown_until(flight, after("tether_snagged"))
    snagged = next(k for k, o in enumerate(result.outputs) if any(e.id == "tether_snagged" for e in o.events))
    before = result.outputs[snagged - 1].contact
    assert before is not None and before.mode is ContactMode.SLIDE and not result.crashed


def test_a_tool_that_is_caught_leads_away_from_the_wall() -> None:
    _, result = slide(2.0, until=after("contact_stuck", 2.5))
    assert "contact_stuck" in [e.id for o in result.outputs for e in o.events]
    assert not result.crashed and result.layout is not None
    assert result.layout.contact(result.snapshots[-1].sensors)[1] == (0.0, 0.0, 0.0)


def test_a_wrong_reading_of_the_force_turns_the_setpoint_by_a_bounded_angle() -> None:
    vehicle, state = load_sitl(SLIDE).vehicle, at(arm=ARM, force=None)
    slide = control.Slide(vehicle)
    slide.torque_nm(0.005, (0.0, 0.0), state, (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), None)
    turned = slide.attitude(0.005, state.attitude_wxyz, state, at_rest(ZERO, 0.0, ARM), (0.0, 0.0, 200.0))
    assert max(map(abs, euler_zyx_from_quat(turned))) == pytest.approx(control.TURN_MAX_RAD)


def test_the_arm_pushes_along_the_way_and_answers_the_force_error_by_a_bounded_force() -> None:
    vehicle, state, into = load_sitl(SLIDE).vehicle, at(arm=ARM, force=None), (1.0, 0.0, 0.0)
    jacobian = np.array(manipulator_of(vehicle).jacobian_body_m(state.arm_rad))[[0, 2]]
    slide = control.Slide(vehicle)

    def tip_force(reading_n: float) -> Any:
        torque = slide.torque_nm(0.005, (0.0, 0.0), state, (3.0, 0.0, -0.5), into, (-reading_n, 0.0, 0.0))
        return np.linalg.solve(jacobian.T, torque)

    assert tip_force(3.0) == pytest.approx([0.0, -0.5])
    for _ in range(200):
        force = tip_force(200.0)
    assert force == pytest.approx([-control.FORCE_MAX_N, -0.5], rel=1e-3)


def test_a_turning_joint_overcomes_the_friction_of_its_gear_and_a_resting_one_gets_nothing() -> None:
    vehicle, law_nm, into = load_sitl(SLIDE).vehicle, (-1.0, 0.5), (1.0, 0.0, 0.0)

    def torque_nm(rate_rad_s: Joints) -> Joints:
        state = at(arm=ARM, arm_rate=rate_rad_s, force=None)
        return control.Slide(vehicle).torque_nm(0.005, law_nm, state, (0.0, 0.0, 0.0), into, None)

    assert torque_nm((0.0, 0.0)) == pytest.approx(law_nm)
    loss_nm = [vehicle.arm.joint_friction_nm + control.GEAR_LOSS_SHARE * abs(torque) for torque in law_nm]
    assert torque_nm((-5.0, -5.0)) == pytest.approx((-1.0 - loss_nm[0], 0.5 - loss_nm[1]))
    assert torque_nm((5.0, 5.0)) == pytest.approx((-1.0 + loss_nm[0], 0.5 + loss_nm[1]))


def test_in_side_wind_and_with_a_sensor_that_reads_30_percent_too_little_force_and_path_are_kept() -> None:
    _, result = slide(
        0.5,
        "world.wind_m_s=[0.0,1.5,0.0]",
        "world.force_scale=0.7",
        "mission.phases[4].speed_m_s=0.04",
        until=contact_over(),
    )
    pairs = [(o.contact, o.reference) for o in result.outputs if o.contact is not None and o.reference is not None]
    turns = [reference.steer_rad or 0.0 for contact, reference in pairs if contact.mode is ContactMode.SLIDE]
    assert 0.01 < max(map(abs, turns)) <= STEER_MAX_RAD
    assert not result.crashed and abs(pairs[-1][1].steer_rad or 0.0) < 1e-3
    assert result.layout is not None
    sliding = [o.contact for o in result.outputs if o.contact is not None and o.contact.mode is ContactMode.SLIDE]
    assert all(abs(contact.unseen_n) <= UNSEEN_MAX_N for contact in sliding)
    assert sliding[-1].unseen_n > 0.6  # 30 % of 3 N, believed by nine tenths
    forces = [
        -result.layout.contact(s.sensors)[1][0]
        for s, o in zip(result.snapshots, result.outputs, strict=True)
        if o.contact is not None and o.contact.mode is ContactMode.SLIDE
    ]
    assert np.mean(forces[-400:]) == pytest.approx(3.0, abs=0.4)  # 4.3 N by the sensor alone
    assert not touches(replace(sliding[-1], force_n=sliding[-1].unseen_n), 1.0)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"displacement_m": [0.3, 0.0]}, "set friction_max to at most 0.1"),
        (
            {"displacement_m": [0.0, 0.3]},
            "of friction (limit 2.12 N m: 0.85 of its torque); lower force_n, or slide downwards",
        ),
        ({"displacement_m": [0.0, -1.0]}, "above standing height"),
        ({"displacement_m": [-2.0, 0.0], "friction_max": 0.0}, "shorten displacement_m"),
    ],
)
def test_the_check_refuses_what_cannot_slide(changes: dict[str, Any], text: str) -> None:
    config = load_sitl(
        SLIDE, overrides=[f"mission.phases[4].{key}={json.dumps(value)}" for key, value in changes.items()]
    )
    assert any(text in problem for problem in check_mission(config.mission, config.vehicle))
