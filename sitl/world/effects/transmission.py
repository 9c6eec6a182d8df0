"""Motor, gear and flexible mount of a joint: the effects `servo_mechanics` and `compliance`.

MuJoCo's joint angle is the true angle of the link. The rotor is integrated here with one degree of freedom per joint: the motor's
torque and the friction act on it, and a spring with backlash connects it to the link. The spring's stiffness is the series stiffness
of gear and mount (or link); the masses between them are negligible. Springs and rotors inside MuJoCo would need bodies for these
masses, and a step of 2 ms cannot represent their frequencies of several hundred hertz.

Friction: Duclusaud et al., "Extended Friction Models for the Physics Simulation of Servo Actuators", ICRA 2025 (arXiv 2410.08650),
model M4, with their update rule: the friction is the torque that would stop the rotor within the step, limited to

    F = friction + load_friction L + exp(-(|v| / stribeck)^exponent) (stiction + load_stiction L) + viscous |v|,

where L = |motor torque - external torque|, and the external torque is the torque of the link on the gear.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from companion.config.vehicle import Vehicle
from companion.model.types import Joints
from companion.sitl_config.effects.servo_mechanics import ServoMechanics
from companion.sitl_config.world import World

ARMATURE_MIN_KG_M2 = 4e-3
"""Smallest simulated rotor inertia, referred to the joint, with which the physics step can represent the oscillation against the
gear.
"""
_WARM_UP_STEPS = 500
STIFF_MAX, STIFF_TARGET = 4.3, 2.0
"""Largest stiffness of the transmissions relative to the physics step, and the stiffness to which `added_inertia_kg_m2` reduces it.
A linear oscillator is stable below 4. The shipped arm reaches 4.2 with `servo_mechanics` alone; its friction keeps it at rest.
"""
_POSES = 16
_ADDED_MAX_KG_M2 = 0.1


class Transmission:
    """Transmission of one joint, with angles and torques in the direction of the joint angle. Call `encoder`, then `step`, in each
    step.

    Args:
        servo: friction, backlash, gear and warm-up.
        armature_kg_m2: inertia of the rotor, referred to the joint.
        gear_rad_per_nm: compliance between the rotor and the encoder.
        outer_rad_per_nm: compliance between the encoder and the base or the link.
        outer_relaxation_s: damping of that outer part divided by its stiffness.
        start_rad: angle of the link at the start; the gear is in the middle of its backlash.
    """

    def __init__(
        self,
        servo: ServoMechanics,
        armature_kg_m2: float,
        gear_rad_per_nm: float,
        outer_rad_per_nm: float,
        outer_relaxation_s: float,
        start_rad: float,
        dt_s: float,
    ) -> None:
        compliance = gear_rad_per_nm + outer_rad_per_nm
        self._stiffness_nm = 1.0 / compliance
        relaxation_s = (servo.gear_relaxation_s * gear_rad_per_nm + outer_relaxation_s * outer_rad_per_nm) / compliance
        self._damping_nms = relaxation_s / compliance
        self._outer_share = outer_rad_per_nm / compliance
        self._half_play_rad = 0.5 * math.radians(servo.backlash_deg)
        self._armature_kg_m2 = max(armature_kg_m2, ARMATURE_MIN_KG_M2)
        self._servo = servo
        self._friction = (servo.friction_nm, servo.stiction_nm, servo.load_friction, servo.load_stiction)
        self._viscous_nms, self._stribeck_rad_s = servo.viscous_nms, servo.stribeck_rad_s
        self._exponent = servo.stribeck_exponent
        self._dt_s = dt_s
        self._rotor_rad, self._rotor_rad_s = start_rad, 0.0
        self._stretch_rad = self._stretch_rad_s = 0.0
        self._step = 0
        self._torque_share = self._friction_share = 1.0

    def stiffness(self) -> tuple[float, float]:
        """Return the stiffness relative to the physics step (stable below 4 times the inertia) and the rotor's inertia, kg m^2."""
        dt_s = self._dt_s
        return dt_s * (self._stiffness_nm * dt_s + 2.0 * self._damping_nms), self._armature_kg_m2

    def encoder(self, link_rad: float, link_rad_s: float) -> tuple[float, float]:
        """Update with the link's angle and velocity, and return the angle and velocity of the servo's output shaft."""
        stretch, half = self._rotor_rad - link_rad, self._half_play_rad
        if stretch > half:
            stretch -= half
        elif stretch < -half:
            stretch += half
        else:
            self._stretch_rad = self._stretch_rad_s = 0.0
            return link_rad, link_rad_s
        rate = self._rotor_rad_s - link_rad_s
        self._stretch_rad, self._stretch_rad_s = stretch, rate
        share = self._outer_share
        return link_rad + share * stretch, link_rad_s + share * rate

    def friction_nm(self, motor_nm: float, external_nm: float, speed_rad_s: float) -> float:
        """Return the largest possible friction torque for these motor and external torques, whose difference is the load.

        `speed_rad_s` is the magnitude of the rotor's speed.
        """
        friction, stiction, load_friction, load_stiction = self._friction
        load = abs(motor_nm - external_nm)
        rest = math.exp(-((speed_rad_s / self._stribeck_rad_s) ** self._exponent))
        return self._friction_share * (
            friction + load_friction * load + rest * (stiction + load_stiction * load) + self._viscous_nms * speed_rad_s
        )

    def step(self, motor_nm: float) -> float:
        """Advance the rotor by one physics step and return the torque on the link in that step.

        `motor_nm` is the torque that the motor would have when cold.
        """
        if self._step % _WARM_UP_STEPS == 0:
            self._warm_up(self._step * self._dt_s)
        self._step += 1
        motor_nm *= self._torque_share
        stretch, torque_nm = self._stretch_rad, 0.0
        if stretch != 0.0:
            torque_nm = self._stiffness_nm * stretch + self._damping_nms * self._stretch_rad_s
            if torque_nm * stretch < 0.0:  # the tooth lifts off instead of pulling
                torque_nm = 0.0
        dt_s, inertia, velocity = self._dt_s, self._armature_kg_m2, self._rotor_rad_s
        net_nm = motor_nm - torque_nm
        stop_nm = inertia / dt_s * velocity + net_nm
        limit_nm = self.friction_nm(motor_nm, -torque_nm, abs(velocity))
        if stop_nm > limit_nm:
            self._rotor_rad_s = (stop_nm - limit_nm) * dt_s / inertia
        elif stop_nm < -limit_nm:
            self._rotor_rad_s = (stop_nm + limit_nm) * dt_s / inertia
        else:
            self._rotor_rad_s = 0.0
        self._rotor_rad += self._rotor_rad_s * dt_s
        return torque_nm

    def _warm_up(self, t_s: float) -> None:
        servo = self._servo
        warm_k = servo.warm_up_k * -math.expm1(-(servo.warm_since_s + t_s) / servo.warm_up_s)
        self._torque_share = 1.0 + servo.torque_constant_per_k * warm_k
        self._friction_share = 1.0 + servo.friction_per_k * warm_k


def acts(world: World) -> bool:
    """Return whether each joint has a rotor of its own; otherwise MuJoCo's joint models armature, friction and damping."""
    return world.servo_mechanics.on or world.compliance.on


def transmissions_of(vehicle: Vehicle, world: World, start_rad: Joints, dt_s: float) -> tuple[Transmission, ...] | None:
    """Return the transmission of each joint, starting at the joint angles `start_rad`; None if neither effect is on.

    With `compliance` alone, the servo has the plain world's constant friction and no backlash.
    """
    if not acts(world):
        return None
    servo, arm = world.servo_mechanics, world.compliance
    gear_rad = math.radians(servo.gear_deg_per_nm) if servo.on else 0.0
    mount_rad = math.radians(arm.mount_deg_per_nm) if arm.on else 0.0
    link_rad = math.radians(arm.link_deg_per_nm) if arm.on else 0.0
    if not servo.on:
        servo = ServoMechanics(
            friction_nm=world.joint_friction_nm,
            viscous_nms=world.joint_damping_nms,
            stiction_nm=0.0,
            load_friction=0.0,
            load_stiction=0.0,
            backlash_deg=0.0,
            warm_up_k=0.0,
        )
    return tuple(
        Transmission(servo, armature, gear_rad, link_rad if joint else mount_rad, arm.relaxation_s, angle_rad, dt_s)
        for joint, (angle_rad, armature) in enumerate(zip(start_rad, vehicle.arm.armatures_kg_m2, strict=True))
    )


def added_inertia_kg_m2(model: mujoco.MjModel, at_q: int, at_v: int, transmissions: Sequence[Transmission]) -> float:
    """Return the inertia to add to every link about its joint, so that the physics step can represent the links on their springs; 0 if
    the links are heavy enough, as those of the shipped arm are.

    Args:
        at_q: index of the vehicle's first element in qpos; its joint angles follow the pose of the base.
        at_v: index of the vehicle's first element in qvel.
    """
    data, poses = mujoco.MjData(model), np.random.default_rng(0)
    stiffness, rotor = np.array([each.stiffness() for each in transmissions]).T
    scale, joints = np.sqrt(np.outer(stiffness, stiffness)), len(transmissions)
    own, joint_q = slice(at_v, at_v + 6 + joints), slice(at_q + 7, at_q + 7 + joints)
    masses, mass = [], np.zeros((model.nv, model.nv))
    for pose in range(_POSES):
        data.qpos[joint_q] = poses.uniform(-math.pi, math.pi, joints) if pose else 0.0
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_crb(model, data)
        mujoco.mj_fullM(model, data, mass)
        masses.append(mass[own, own].copy())

    def stiffest(added_kg_m2: float) -> float:
        added = np.zeros(6 + joints)
        added[6:] = added_kg_m2
        inverse = np.linalg.inv(np.array(masses) + np.diag(added))[:, 6:, 6:]
        return float(np.linalg.eigvalsh((inverse + np.diag(1.0 / rotor)) * scale).max())

    if stiffest(0.0) <= STIFF_MAX:
        return 0.0
    added_kg_m2 = 1e-5
    while stiffest(added_kg_m2) > STIFF_TARGET and added_kg_m2 < _ADDED_MAX_KG_M2:
        added_kg_m2 *= 1.25
    return added_kg_m2
