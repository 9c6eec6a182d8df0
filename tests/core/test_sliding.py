"""A slide along a surface in the fast loop: force and path, a tool that is caught, and what the check refuses."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from companion.analysis.contact import contact_lines, contact_summary
from companion.control import slide as control
from companion.control.arm_model import manipulator_of
from companion.control.types import PlantState
from companion.core.flight_core import FlightCore
from companion.mission.check import check_mission
from companion.model.frames import euler_zyx_from_quat
from companion.model.types import ContactMode, Joints, Outcome
from companion.sitl_config.loader import load_sitl
from sitl.campaigns.flights import row_of
from sitl.fast.loop import FastFlight, FastResult

SLIDE = "configs/missions/slide.yaml"


def slide(friction: float) -> tuple[FastFlight, FastResult]:
    """Fly a short slide in the ideal world, with little of a way to the wall and back."""
    wall = {"point_m": [1.5, 0.0, 1.09], "normal": [-1.0, 0.0, 0.0], "stiffness_n_m": 1e4, "friction": friction}
    overrides = [
        f"world.surfaces={json.dumps([wall])}",
        "mission.start.position_m=[0.4,0.0]",
        "mission.phases[3]={type: approach, direction: [1.0, 0.0, 0.0], distance_max_m: 0.35, speed_m_s: 0.05}",
        "mission.phases[4].by_m=[0.0,-0.3]",
        "mission.phases[6].to_m=[0.5,0.0,1.35]",
    ]
    flight = FastFlight(load_sitl(SLIDE, world="ideal", overrides=overrides))
    return flight, flight.run(90.0)


def test_the_tip_follows_its_path_while_the_force_is_held() -> None:
    flight, result = slide(0.5)
    assert result.outputs[-1].outcome is Outcome.COMPLETED and not result.crashed and result.layout is not None
    assert {e.id for o in result.outputs for e in o.events} == {"takeoff", "touched", "touchdown"}
    sliding = np.array([o.contact is not None and o.contact.mode is ContactMode.SLIDE for o in result.outputs])
    tips, forces = zip(*(result.layout.contact(s.sensors) for s in result.snapshots), strict=True)
    tip, force_n = np.array(tips)[sliding], -np.array(forces)[sliding, 0]
    assert tip[-1][2] - tip[0][2] == pytest.approx(-0.3, abs=0.02) and np.ptp(tip[:, 1]) < 0.01
    assert np.sqrt(np.mean((force_n - 3.0) ** 2)) < 0.45
    log = row_of(flight.config.flight, result, None)[1]
    summary = contact_summary(log)
    assert summary is not None and summary["path_rms_m"] < 0.012
    assert ("slide", "0.30 m along the surface") in contact_lines({"contact": summary})
    core = FlightCore(flight.config.flight)
    assert all(core.step(i) == o for i, o in zip(result.inputs, result.outputs, strict=True))


def test_a_tool_that_is_caught_leads_away_from_the_wall() -> None:
    _, result = slide(2.0)
    assert "contact_stuck" in [e.id for o in result.outputs for e in o.events]
    assert result.outputs[-1].outcome is Outcome.ABORTED and not result.crashed


def test_a_wrong_reading_of_the_force_turns_the_setpoint_by_a_bounded_angle() -> None:
    vehicle, state = load_sitl(SLIDE).vehicle, at_rest()
    level = state.attitude_wxyz
    slide = control.Slide(vehicle)
    slide.torque_nm(0.005, (0.0, 0.0), state, (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), None)
    turned = slide.attitude(0.005, level, state, (0.0, 0.0, 200.0))
    assert max(map(abs, euler_zyx_from_quat(turned))) == pytest.approx(control.TURN_MAX_RAD)


def test_the_arm_yields_across_the_surface_and_answers_the_force_error_by_a_bounded_force() -> None:
    vehicle, state = load_sitl(SLIDE).vehicle, at_rest()
    into, slide = (1.0, 0.0, 0.0), control.Slide(vehicle)
    jacobian = np.array(manipulator_of(vehicle).jacobian_body_m(state.arm_rad))[[0, 2]]

    def tip_force(arm: Joints, reading_n: float) -> Any:
        moved = replace(state, arm_rad=arm)
        torque = slide.torque_nm(0.005, (0.0, 0.0), moved, (3.0, 0.0, 0.0), into, (-reading_n, 0.0, 0.0))
        return np.linalg.solve(jacobian.T, torque)

    assert np.abs(tip_force(state.arm_rad, 3.0)).max() < 1e-9
    across, along = (np.linalg.solve(jacobian, step) for step in ([0.005, 0.0], [0.0, 0.005]))
    a, b = state.arm_rad
    assert np.abs(tip_force((a + across[0], b + across[1]), 3.0)).max() < 0.05
    assert tip_force((a + along[0], b + along[1]), 3.0)[1] < -0.1
    for _ in range(200):
        force = tip_force(state.arm_rad, 200.0)
    assert force[0] == pytest.approx(-control.FORCE_MAX_N, rel=1e-3) and abs(force[1]) < 1e-9


def at_rest() -> PlantState:
    """Return the state of a level vehicle at rest whose arm is stretched."""
    rest = (0.0, 0.0, 0.0)
    return PlantState(
        position_world_m=rest,
        velocity_world_m_s=rest,
        acceleration_world_m_s2=rest,
        attitude_wxyz=(1.0, 0.0, 0.0, 0.0),
        angular_rate_body_rad_s=rest,
        arm_rad=(1.1, 1.4),
        arm_rate_rad_s=(0.0, 0.0),
    )


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"by_m": [0.3, 0.0]}, "set friction_max to at most 0.1"),
        ({"by_m": [0.0, 0.3]}, "of friction (limit 2.12 N m: 0.85 of its torque); lower force_n, or slide downwards"),
        ({"by_m": [0.0, -1.0]}, "above standing height"),
        ({"by_m": [-2.0, 0.0], "friction_max": 0.0}, "shorten by_m"),
    ],
)
def test_the_check_refuses_what_cannot_slide(changes: dict[str, Any], text: str) -> None:
    config = load_sitl(
        SLIDE, overrides=[f"mission.phases[4].{key}={json.dumps(value)}" for key, value in changes.items()]
    )
    assert any(text in problem for problem in check_mission(config.mission, config.vehicle))
