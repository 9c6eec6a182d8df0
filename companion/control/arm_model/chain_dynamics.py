"""Dynamics of a vehicle with any arm, by composite rigid bodies and recursive Newton-Euler.

After Featherstone, "Rigid Body Dynamics Algorithms", 2008, tables 6.2 and 5.1. All vectors are in body axes, and all moments and
velocities refer to the body origin, so that nothing is transformed between links: a joint at p with the axis a has the motion vector
S = (a, p x a), and a rigid body is described by its mass, its first moment and its inertia about the origin.
"""

from __future__ import annotations

from companion.control.arm_model.chain_kinematics import ChainKinematics, Frame
from companion.control.dynamics import ArmTerms, Dynamics, DynamicsTerms, euler_rate_matrices
from companion.model.algebra import cross, dot, mat_mat, mat_vec, plus, transpose, vec_mat
from companion.model.arm_chain import ArmChain
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import Chi, Joints, Mat3, Vec3

_Body = tuple[float, Vec3, Mat3]
"""Mass, first moment and inertia about the body origin."""
_Pair = tuple[Vec3, Vec3]
"""An angular and a linear vector."""
_ZERO: Vec3 = (0.0, 0.0, 0.0)


class ChainDynamics(Dynamics):
    """The nominal model of a vehicle with any arm.

    Args:
        chain: arm and tool.
        mass_kg: mass of the whole vehicle.
        base_inertia_kg_m2: moments of inertia of the base about the body axes.
        mass_scale: factor on every mass and inertia.
    """

    def __init__(self, chain: ArmChain, mass_kg: float, base_inertia_kg_m2: Vec3, mass_scale: float) -> None:
        self._kinematics = ChainKinematics(chain)
        self._total_kg = mass_scale * mass_kg
        x, y, z = base_inertia_kg_m2
        self._base: Mat3 = ((mass_scale * x, 0.0, 0.0), (0.0, mass_scale * y, 0.0), (0.0, 0.0, mass_scale * z))
        self._armatures = tuple([mass_scale * link.armature_kg_m2 for link in chain.links])
        self._links = tuple(
            [(mass_scale * mass, com, _times(mass_scale, inertia)) for mass, com, inertia in _links_with_tool(chain)]
        )

    def arm_terms(self, angle_rad: Joints, rate_rad_s: Joints) -> ArmTerms:
        """See `Dynamics`."""
        frames = self._kinematics.frames(angle_rad)
        bodies, axes = self._bodies(frames), _axes(frames)
        still = (0.0,) * len(frames)
        _, _, coriolis = _newton_euler(bodies, axes, _ZERO, rate_rad_s, still)
        _, momenta = _composites(bodies, axes)
        return ArmTerms(self._joint_mass(axes, momenta), tuple(coriolis))

    def arm_torque_nm(self, angle_rad: Joints, rate_rad_s: Joints, acceleration_rad_s2: Joints) -> Joints:
        """See `Dynamics`."""
        frames = self._kinematics.frames(angle_rad)
        _, _, torques = _newton_euler(self._bodies(frames), _axes(frames), _ZERO, rate_rad_s, acceleration_rad_s2)
        return tuple(
            [
                torque + armature * acceleration
                for torque, armature, acceleration in zip(torques, self._armatures, acceleration_rad_s2, strict=True)
            ]
        )

    def terms(self, rotation: Mat3, roll_pitch_yaw_rad: Vec3, angle_rad: Joints, chi_rate: Chi) -> DynamicsTerms:
        """See `Dynamics`."""
        w, w_rate = euler_rate_matrices(roll_pitch_yaw_rad, chi_rate)
        q_rate = (chi_rate[3], chi_rate[4], chi_rate[5])
        omega = mat_vec(w, q_rate)
        up_x, up_y, up_z = rotation[2]
        up = (up_x * GRAVITY_M_S2, up_y * GRAVITY_M_S2, up_z * GRAVITY_M_S2)

        frames = self._kinematics.frames(angle_rad)
        bodies, axes = self._bodies(frames), _axes(frames)
        arm, momenta = _composites(bodies, axes)
        still = (0.0,) * len(frames)
        turning, force, joint_torques = _newton_euler(bodies, axes, omega, chi_rate[6:], still)
        moment, inertia = arm[1], _sum(self._base, arm[2])
        turning = plus(turning, cross(omega, mat_vec(self._base, omega)))

        # M_p,omega = -[h]x, carried to chi: R (-[h]x) W.
        hx, hy, hz = moment
        minus_h: Mat3 = ((0.0, hz, -hy), (-hz, 0.0, hx), (hy, -hx, 0.0))
        p_q = mat_mat(rotation, mat_mat(minus_h, w))
        q_q = mat_mat(transpose(w), mat_mat(inertia, w))
        p_a = [mat_vec(rotation, linear) for _, linear in momenta]
        q_a = [vec_mat(angular, w) for angular, _ in momenta]

        # C chi' = T' (c + M [0; W' q'; 0]).
        extra = mat_vec(w_rate, q_rate)
        c_p = mat_vec(rotation, plus(force, mat_vec(minus_h, extra)))
        c_q = vec_mat(plus(turning, mat_vec(inertia, extra)), w)
        c_a = [torque + dot(angular, extra) for torque, (angular, _) in zip(joint_torques, momenta, strict=True)]
        g_q = vec_mat(cross(moment, up), w)
        g_a = [dot(linear, up) for _, linear in momenta]

        total = self._total_kg
        p_p: Mat3 = ((total, 0.0, 0.0), (0.0, total, 0.0), (0.0, 0.0, total))
        q_p = transpose(p_q)
        joint_mass = self._joint_mass(axes, momenta)
        mass = (
            *[(*p_p[i], *p_q[i], *[column[i] for column in p_a]) for i in range(3)],
            *[(*q_p[i], *q_q[i], *[column[i] for column in q_a]) for i in range(3)],
            *[(*p, *q, *row) for p, q, row in zip(p_a, q_a, joint_mass, strict=True)],
        )
        return DynamicsTerms(mass, (*c_p, *c_q, *c_a), (0.0, 0.0, total * GRAVITY_M_S2, *g_q, *g_a))

    def _bodies(self, frames: list[Frame]) -> list[_Body]:
        """Return every link in body axes."""
        bodies: list[_Body] = []
        for (rotation, position, _), (mass, com, inertia) in zip(frames, self._links, strict=True):
            x, y, z = plus(position, mat_vec(rotation, com))
            mx, my, mz = mass * x, mass * y, mass * z
            (xx, xy, xz), (_, yy, yz), (_, _, zz) = mat_mat(rotation, mat_mat(inertia, transpose(rotation)))
            xx, yy, zz = xx + my * y + mz * z, yy + mx * x + mz * z, zz + mx * x + my * y
            xy, xz, yz = xy - mx * y, xz - mx * z, yz - my * z
            bodies.append((mass, (mx, my, mz), ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))))
        return bodies

    def _joint_mass(self, axes: list[_Pair], momenta: list[_Pair]) -> tuple[tuple[float, ...], ...]:
        """Return the joints' block of M. Element (j, k), k >= j, is the moment about joint j of the momentum that joint k causes."""
        rows = [[0.0] * len(axes) for _ in axes]
        for k, (angular, linear) in enumerate(momenta):
            for j in range(k + 1):
                axis, at_origin = axes[j]
                rows[j][k] = rows[k][j] = dot(axis, angular) + dot(at_origin, linear)
            rows[k][k] += self._armatures[k]
        return tuple([tuple(row) for row in rows])


def _axes(frames: list[Frame]) -> list[_Pair]:
    """Return S of every joint."""
    return [(axis, cross(position, axis)) for _, position, axis in frames]


def _momentum(body: _Body, omega: Vec3, velocity: Vec3) -> _Pair:
    """Return the angular and the linear momentum of a body that moves with this velocity at the origin."""
    mass, moment, inertia = body
    x, y, z = cross(omega, moment)
    vx, vy, vz = velocity
    return plus(mat_vec(inertia, omega), cross(moment, velocity)), (x + mass * vx, y + mass * vy, z + mass * vz)


def _composites(bodies: list[_Body], axes: list[_Pair]) -> tuple[_Body, list[_Pair]]:
    """Return the whole arm as one body, and the momentum that each joint causes at unit rate."""
    whole: _Body = (0.0, _ZERO, (_ZERO, _ZERO, _ZERO))
    momenta: list[_Pair] = []
    for number in range(len(bodies) - 1, -1, -1):
        mass, moment, inertia = bodies[number]
        whole = (whole[0] + mass, plus(whole[1], moment), _sum(whole[2], inertia))
        axis, at_origin = axes[number]
        momenta.append(_momentum(whole, axis, at_origin))
    momenta.reverse()
    return whole, momenta


def _newton_euler(
    bodies: list[_Body], axes: list[_Pair], omega: Vec3, rate_rad_s: Joints, acceleration_rad_s2: Joints
) -> tuple[Vec3, Vec3, list[float]]:
    """Return the torque and the force on the base, and the joint torques, that the motion of the arm needs without gravity. The base
    turns at the constant rate `omega` about its origin, which does not accelerate.
    """
    w, v, dw, dv = omega, _ZERO, _ZERO, _ZERO
    forces: list[_Pair] = []
    for body, (axis, at_origin), rate, acceleration in zip(bodies, axes, rate_rad_s, acceleration_rad_s2, strict=True):
        turned = plus(cross(w, at_origin), cross(v, axis))
        dw = _plus_two(dw, rate, cross(w, axis), acceleration, axis)
        dv = _plus_two(dv, rate, turned, acceleration, at_origin)
        w, v = _plus_one(w, rate, axis), _plus_one(v, rate, at_origin)
        angular, linear = _momentum(body, w, v)
        torque, force = _momentum(body, dw, dv)
        torque = plus(torque, plus(cross(w, angular), cross(v, linear)))
        forces.append((torque, plus(force, cross(w, linear))))
    torque, force = _ZERO, _ZERO
    joint_torques: list[float] = []
    for number in range(len(bodies) - 1, -1, -1):
        own_torque, own_force = forces[number]
        torque, force = plus(torque, own_torque), plus(force, own_force)
        axis, at_origin = axes[number]
        joint_torques.append(dot(axis, torque) + dot(at_origin, force))
    joint_torques.reverse()
    return torque, force, joint_torques


def _links_with_tool(chain: ArmChain) -> list[tuple[float, Vec3, Mat3]]:
    """Return mass, centre of mass and inertia about it, in the link's frame; the tool is part of the last link."""
    links = [(link.mass_kg, link.com_m, link.inertia_kg_m2) for link in chain.links]
    if links and chain.tool_mass_kg > 0.0:
        mass, com, inertia = links[-1]
        tool, tip, ball = chain.tool_mass_kg, chain.tip_m, chain.tool_inertia_kg_m2
        both = mass + tool
        x, y, z = (tip[0] - com[0], tip[1] - com[1], tip[2] - com[2])
        share = tool / both
        reduced = mass * share
        shifted: Mat3 = (
            (ball + reduced * (y * y + z * z), -reduced * x * y, -reduced * x * z),
            (-reduced * x * y, ball + reduced * (x * x + z * z), -reduced * y * z),
            (-reduced * x * z, -reduced * y * z, ball + reduced * (x * x + y * y)),
        )
        links[-1] = (both, _plus_one(com, share, (x, y, z)), _sum(inertia, shifted))
    return links


def _plus_one(a: Vec3, factor: float, b: Vec3) -> Vec3:
    return (a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2])


def _plus_two(a: Vec3, first: float, b: Vec3, second: float, c: Vec3) -> Vec3:
    return (
        a[0] + first * b[0] + second * c[0],
        a[1] + first * b[1] + second * c[1],
        a[2] + first * b[2] + second * c[2],
    )


def _sum(m: Mat3, n: Mat3) -> Mat3:
    return (plus(m[0], n[0]), plus(m[1], n[1]), plus(m[2], n[2]))


def _times(factor: float, m: Mat3) -> Mat3:
    a, b, c = ((factor * row[0], factor * row[1], factor * row[2]) for row in m)
    return (a, b, c)
