"""Friction, backlash, springs, current loop and warm-up of the servos against their closed forms."""

from __future__ import annotations

import math
from typing import Any

import pytest

from companion.sitl_config.effects.compliance import Compliance
from companion.sitl_config.effects.servo_mechanics import GEAR_MIN_DEG_PER_NM, ServoMechanics
from companion.sitl_config.world import World as WorldConfig
from sitl.servo.drive import AMP_PER_COUNT, MODE_CURRENT
from sitl.servo.from_config import servos_of
from sitl.world.effects.transmission import ARMATURE_MIN_KG_M2, Transmission, transmissions_of
from sitl.world.model import mjcf
from sitl.world.state import PHYSICS_DT_S
from tests.preflight.hand_rig import world
from tests.sitl.test_airframe import VEHICLE

DT_S = PHYSICS_DT_S
GEAR = math.radians(GEAR_MIN_DEG_PER_NM)
COLD = {"warm_up_k": 0.0}


def joint(outer: float = 0.0, armature_kg_m2: float = 0.008, **changes: Any) -> Transmission:
    servo = ServoMechanics(on=True, **{**COLD, **changes})
    return Transmission(servo, armature_kg_m2, GEAR, outer, Compliance().relaxation_s, 0.0, DT_S)


class Link:
    """A link of one degree of freedom under an external torque; semi-implicit as MuJoCo."""

    def __init__(self, transmission: Transmission, external_nm: float, damping_nms: float) -> None:
        self._transmission, self.external_nm, self._damping_nms = transmission, external_nm, damping_nms
        self.inertia_kg_m2 = 0.02
        self.rad = self.rad_s = self.torque_nm = self.encoder_rad = 0.0

    def run(self, motor_nm: float, time_s: float) -> None:
        for _ in range(round(time_s / DT_S)):
            self.encoder_rad, _ = self._transmission.encoder(self.rad, self.rad_s)
            self.torque_nm = self._transmission.step(motor_nm)
            acceleration = (self.torque_nm + self.external_nm - self._damping_nms * self.rad_s) / self.inertia_kg_m2
            self.rad_s += acceleration * DT_S
            self.rad += self.rad_s * DT_S

    def moves(self, motor_nm: float) -> bool:
        """Hold the load with the motor until the link rests, then apply a torque; return whether the link leaves within a second."""
        self.run(-self.external_nm, 0.5)
        before_rad, self._damping_nms = self.rad, 0.0
        self.run(motor_nm, 1.0)
        return abs(self.rad - before_rad) > 0.02


@pytest.mark.parametrize("load_nm", [0.0, 1.0])
def test_the_joint_breaks_away_where_friction_and_load_say(load_nm: float) -> None:
    servo = ServoMechanics()
    still, share = servo.friction_nm + servo.stiction_nm, servo.load_friction + servo.load_stiction
    lift_nm = (load_nm + still + share * load_nm) / (1.0 - share)
    drop_nm = (load_nm - still - share * load_nm) / (1.0 + share) if load_nm > 0.0 else -lift_nm
    for torque_nm, breaks_away in (
        (lift_nm - 0.004, False),
        (lift_nm + 0.004, True),
        (drop_nm + 0.004, False),
        (drop_nm - 0.004, True),
    ):
        link = Link(joint(backlash_deg=0.0), -load_nm, damping_nms=1.0)
        assert link.moves(torque_nm) == breaks_away, torque_nm


@pytest.mark.parametrize("speed_rad_s", [0.05, 1.6])
def test_a_dragged_joint_resists_along_the_stribeck_curve(speed_rad_s: float) -> None:
    servo, transmission = ServoMechanics(), joint()
    rad = 0.0
    for _ in range(4000):
        rad += speed_rad_s * DT_S
        transmission.encoder(rad, speed_rad_s)
        torque_nm = transmission.step(0.0)
    rest = math.exp(-((speed_rad_s / servo.stribeck_rad_s) ** servo.stribeck_exponent))
    share = servo.load_friction + rest * servo.load_stiction
    friction = servo.friction_nm + rest * servo.stiction_nm + servo.viscous_nms * speed_rad_s
    assert torque_nm == pytest.approx(-friction / (1.0 - share), rel=0.01)


def test_a_link_is_free_over_the_backlash_after_its_reversal() -> None:
    transmission, step_rad = joint(backlash_deg=0.25), math.radians(0.001)
    rad, free = 0.0, 0

    def sweep(to_rad: float) -> None:
        nonlocal rad, free
        direction = math.copysign(step_rad, to_rad - rad)
        while abs(to_rad - rad) > 0.5 * step_rad:
            rad += direction
            shaft_rad, _ = transmission.encoder(rad, direction / DT_S)
            assert shaft_rad == rad
            free += transmission.step(0.0) == 0.0

    sweep(math.radians(1.0))
    free = 0
    sweep(math.radians(-1.0))
    assert free * 0.001 == pytest.approx(0.25, abs=0.003)


def test_under_1_n_m_gear_and_mount_yield_and_the_encoder_sees_only_the_gear() -> None:
    mount = math.radians(1.0)
    link = Link(joint(outer=mount, backlash_deg=0.25, friction_nm=5.0), -1.0, damping_nms=1.0)
    link.run(0.0, 1.0)
    play = math.radians(0.125)
    assert link.rad == pytest.approx(-play - GEAR - mount, rel=1e-3)
    assert link.encoder_rad == pytest.approx(-play - GEAR, rel=1e-3)


def test_the_stiffest_gear_on_the_lightest_rotor_and_link_stays_stable() -> None:
    """The least inertia that the elbow feels with the base and the shoulder free, over all poses of the arm, is 0.0013 kg m2."""
    stiff = ServoMechanics(
        friction_nm=0.0, stiction_nm=0.0, load_friction=0.0, load_stiction=0.0, viscous_nms=0.0, backlash_deg=0.0
    )
    transmission = Transmission(
        stiff, 0.0, math.radians(GEAR_MIN_DEG_PER_NM), 0.0, Compliance().relaxation_s, 0.0, DT_S
    )
    link = Link(transmission, 0.0, damping_nms=0.0)
    link.inertia_kg_m2 = 0.0013
    link.run(0.0, DT_S)
    link.rad_s = 5.0
    link.run(0.0, 1.0)
    together_rad_s = 0.0013 * 5.0 / (0.0013 + ARMATURE_MIN_KG_M2)
    assert link.rad_s == pytest.approx(together_rad_s, rel=1e-3)


def test_a_warm_motor_has_less_torque_per_ampere_and_less_friction() -> None:
    changes = {"warm_up_k": 30.0, "warm_since_s": 1e6, "friction_per_k": -0.005, "torque_constant_per_k": -0.0011}
    held = joint(backlash_deg=0.0, stiction_nm=0.0, load_friction=0.0, load_stiction=0.0, **changes)
    share = 1.0 - 30.0 * 0.0011
    for _ in range(500):
        held.encoder(0.0, 0.0)
        torque_nm = held.step(1.0)
    assert held.friction_nm(0.0, 0.0, 0.0) == pytest.approx(0.85 * ServoMechanics().friction_nm)
    assert torque_nm == pytest.approx(share, abs=0.85 * ServoMechanics().friction_nm)
    fresh = joint(**{**changes, "warm_since_s": 0.0})
    fresh.step(0.0)
    assert fresh.friction_nm(0.0, 0.0, 0.0) > 0.99 * (ServoMechanics().friction_nm + ServoMechanics().stiction_nm)


def test_the_present_current_follows_the_goal_with_the_time_constant_of_the_loop() -> None:
    [drive, _] = [servo.drive for servo in servos_of(VEHICLE, world("servo_mechanics.on=true").world)]
    drive.mode, drive.torque_on = MODE_CURRENT, True
    drive.update(0.0, 0.0, 0.0)
    drive.set_goal_current(500)
    for n in range(1, 8):
        current_a = drive.update(n * DT_S, 0.0, 0.0)
        expected = 500 * (1.0 - math.exp(-n * DT_S / 0.003))
        assert current_a == pytest.approx(expected * AMP_PER_COUNT)
        assert drive.present()[0] == round(expected)


def test_without_both_effects_the_joints_are_mujoco_s() -> None:
    plain = WorldConfig(joint_friction_nm=0.03, joint_damping_nms=0.02)
    assert transmissions_of(VEHICLE, plain, (1.0, 1.0), DT_S) is None
    assert 'frictionloss="0.03" damping="0.02"' in mjcf([(VEHICLE, plain)], DT_S)
    for effect in ({"servo_mechanics": ServoMechanics(on=True)}, {"compliance": Compliance(on=True)}):
        mine = plain.model_copy(update=effect)
        assert transmissions_of(VEHICLE, mine, (1.0, 1.0), DT_S) is not None
        assert 'frictionloss="0.0" damping="0.0"' in mjcf([(VEHICLE, mine)], DT_S)
