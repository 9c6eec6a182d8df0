"""A vehicle whose arm is a URDF file flies: yaw joint, three pitch joints, servos of two models."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.mission.check import check_mission
from companion.sitl_config.loader import load_sitl
from sitl.fast.loop import FastFlight

pytestmark = pytest.mark.usefixtures("short_start")

CATCH_S = 10.7


def test_an_arm_of_four_joints_from_a_urdf_catches_the_payload() -> None:
    config = load_sitl("catch", vehicle_path="tarot650_4r", world="ideal", overrides=["world.payload_kg=0.2"])
    assert check_mission(config.mission, config.vehicle) == []
    outputs = FastFlight(config).run(limit_s=CATCH_S).outputs
    assert "catch" in {event.id for output in outputs for event in output.events}
    controls = [output.control for output in outputs if output.control is not None]
    assert np.max(np.abs([control.error[:3] for control in controls[-200:]])) < 0.25
    assert np.max(np.abs([control.error[6:] for control in controls])) < math.radians(20.0)
