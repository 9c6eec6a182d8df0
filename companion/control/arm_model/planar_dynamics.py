"""Dynamics of a vehicle with a planar 2R arm (angles as in `planar_manipulator`), written out.

The arm moves in the body's x-z plane, which leaves few terms. On a fixed base, with beta = alpha_2, its equation of motion is

    M = [[A + B + 2 C cos beta, -(B + C cos beta)], [., B]] + armature
    Coriolis = C sin beta [alpha_2' (alpha_2' - 2 alpha_1'), alpha_1'^2]
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.control.dynamics import ArmTerms, Dynamics, DynamicsTerms, euler_rate_matrices
from companion.model.algebra import mat_mat, mat_vec, transpose, vec_mat
from companion.model.arm_chain import ROD_AXIAL_KG_M2, ROD_AXIAL_SHARE, ArmChain
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import Chi, Joints, Mat3, Matrix, Vec3

_Vec4 = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class _Part:
    """A rigid part of the arm at the body position (x, y, z), as a function of the joint angles.

    Its centre moves by (jx . alpha', 0, jz . alpha'), accelerates by (kx, 0, kz) when the joint rates are constant, and rotates with
    `turn` . alpha' about body y. Its inertia in body axes is [[xx, 0, xz], [0, yy, 0], [xz, 0, zz]].
    """

    mass_kg: float
    x: float
    z: float
    jx: Joints
    jz: Joints
    kx: float
    kz: float
    turn: Joints
    rate: float
    xx: float
    yy: float
    zz: float
    xz: float


class PlanarDynamics(Dynamics):
    """The nominal model of a vehicle with a planar 2R arm; arguments as for `ChainDynamics`."""

    def __init__(self, chain: ArmChain, mass_kg: float, base_inertia_kg_m2: Vec3, mass_scale: float) -> None:
        first, second = chain.links
        self._scale = mass_scale
        self._l1, self._l2 = second.position_m[0], chain.tip_m[0]
        self._m1, self._m2 = mass_scale * first.mass_kg, mass_scale * second.mass_kg
        self._c1, self._c2 = first.com_m[0], second.com_m[0]
        self._tool_kg = mass_scale * chain.tool_mass_kg
        self._tool_inertia = mass_scale * chain.tool_inertia_kg_m2
        self._total_kg = mass_scale * mass_kg
        self._shoulder = first.position_m
        ix, iy, iz = base_inertia_kg_m2
        self._base_inertia = (mass_scale * ix, mass_scale * iy, mass_scale * iz)
        self._armature_1 = mass_scale * first.armature_kg_m2
        self._armature_2 = mass_scale * second.armature_kg_m2
        at_rest: Joints = (0.0, 0.0)
        stretched, bent = (self.arm_terms((0.0, beta), at_rest).mass for beta in (0.0, math.pi / 2))
        self._outer = stretched[1][1] - self._armature_2
        self._cross = -stretched[0][1] - self._outer
        self._inner = bent[0][0] - self._armature_1 - self._outer

    def arm_terms(self, angle_rad: Joints, rate_rad_s: Joints) -> ArmTerms:
        """See `Dynamics`."""
        m11 = m12 = m22 = c1 = c2 = 0.0
        for part in self._parts(angle_rad, rate_rad_s):
            m, jx, jz = part.mass_kg, part.jx, part.jz
            t1, t2 = part.turn
            m11 += m * (jx[0] * jx[0] + jz[0] * jz[0]) + part.yy * t1 * t1
            m12 += m * (jx[0] * jx[1] + jz[0] * jz[1]) + part.yy * t1 * t2
            m22 += m * (jx[1] * jx[1] + jz[1] * jz[1]) + part.yy * t2 * t2
            c1 += m * (jx[0] * part.kx + jz[0] * part.kz)
            c2 += m * (jx[1] * part.kx + jz[1] * part.kz)
        return ArmTerms(((m11 + self._armature_1, m12), (m12, m22 + self._armature_2)), (c1, c2))

    def arm_torque_nm(self, angle_rad: Joints, rate_rad_s: Joints, acceleration_rad_s2: Joints) -> Joints:
        """See `Dynamics`; the closed form costs a tenth of `arm_terms`."""
        beta = angle_rad[1]
        v1, v2 = rate_rad_s
        a1, a2 = acceleration_rad_s2
        cross, coriolis = self._cross * math.cos(beta), self._cross * math.sin(beta)
        m12 = -(self._outer + cross)
        m11 = self._inner + self._outer + 2.0 * cross + self._armature_1
        return (
            m11 * a1 + m12 * a2 + coriolis * v2 * (v2 - 2.0 * v1),
            m12 * a1 + (self._outer + self._armature_2) * a2 + coriolis * v1 * v1,
        )

    def terms(self, rotation: Mat3, roll_pitch_yaw_rad: Vec3, angle_rad: Joints, chi_rate: Chi) -> DynamicsTerms:
        """See `Dynamics`."""
        w, w_rate = euler_rate_matrices(roll_pitch_yaw_rad, chi_rate)
        q_rate = (chi_rate[3], chi_rate[4], chi_rate[5])
        omega = mat_vec(w, q_rate)
        ox, oy, oz = omega
        a1, a2 = chi_rate[6], chi_rate[7]
        bx, by, bz = self._base_inertia
        sy = self._shoulder[1]
        up = (rotation[2][0] * GRAVITY_M_S2, rotation[2][1] * GRAVITY_M_S2, rotation[2][2] * GRAVITY_M_S2)

        # First moment, inertia about the origin, coupling columns; then forces and torques at constant rates.
        hx = hy = hz = 0.0
        ixx, iyy, izz, ixy, ixz, iyz = bx, by, bz, 0.0, 0.0, 0.0
        px1 = px2 = pz1 = pz2 = 0.0
        w11 = w12 = w21 = w22 = w31 = w32 = 0.0
        m11 = m12 = m22 = 0.0
        fx = fy = fz = 0.0
        nx, ny, nz = oy * oz * (bz - by), oz * ox * (bx - bz), ox * oy * (by - bx)
        c1 = c2 = g1 = g2 = 0.0
        for part in self._parts(angle_rad, (a1, a2)):
            m, x, z, jx, jz = part.mass_kg, part.x, part.z, part.jx, part.jz
            t1, t2 = part.turn
            hx, hy, hz = hx + m * x, hy + m * sy, hz + m * z
            ixx += part.xx + m * (sy * sy + z * z)
            iyy += part.yy + m * (x * x + z * z)
            izz += part.zz + m * (x * x + sy * sy)
            ixy -= m * x * sy
            ixz += part.xz - m * x * z
            iyz -= m * sy * z
            px1, px2, pz1, pz2 = px1 + m * jx[0], px2 + m * jx[1], pz1 + m * jz[0], pz2 + m * jz[1]
            w11, w12 = w11 + m * sy * jz[0], w12 + m * sy * jz[1]
            w21 += m * (z * jx[0] - x * jz[0]) + part.yy * t1
            w22 += m * (z * jx[1] - x * jz[1]) + part.yy * t2
            w31, w32 = w31 - m * sy * jx[0], w32 - m * sy * jx[1]
            m11 += m * (jx[0] * jx[0] + jz[0] * jz[0]) + part.yy * t1 * t1
            m12 += m * (jx[0] * jx[1] + jz[0] * jz[1]) + part.yy * t1 * t2
            m22 += m * (jx[1] * jx[1] + jz[1] * jz[1]) + part.yy * t2 * t2

            # Acceleration of the centre: centripetal, Coriolis, and the arm's own.
            vx, vz = jx[0] * a1 + jx[1] * a2, jz[0] * a1 + jz[1] * a2
            along = ox * x + oy * sy + oz * z
            square = ox * ox + oy * oy + oz * oz
            ax = m * (ox * along - x * square + 2.0 * oy * vz + part.kx)
            ay = m * (oy * along - sy * square + 2.0 * (oz * vx - ox * vz))
            az = m * (oz * along - z * square - 2.0 * oy * vx + part.kz)
            fx, fy, fz = fx + ax, fy + ay, fz + az
            # Its spin: I (omega x y s) + omega_i x (I omega_i), omega_i = omega + y s.
            s = part.rate
            oiy = oy + s
            lx, ly, lz = part.xx * ox + part.xz * oz, part.yy * oiy, part.xz * ox + part.zz * oz
            kx, kz = -oz * s, ox * s
            spin_x = part.xx * kx + part.xz * kz + oiy * lz - oz * ly
            spin_y = oz * lx - ox * lz
            spin_z = part.xz * kx + part.zz * kz + ox * ly - oiy * lx
            nx += sy * az - z * ay + spin_x
            ny += z * ax - x * az + spin_y
            nz += x * ay - sy * ax + spin_z
            c1 += jx[0] * ax + jz[0] * az + t1 * spin_y
            c2 += jx[1] * ax + jz[1] * az + t2 * spin_y
            g1 += m * (jx[0] * up[0] + jz[0] * up[2])
            g2 += m * (jx[1] * up[0] + jz[1] * up[2])

        inertia: Mat3 = ((ixx, ixy, ixz), (ixy, iyy, iyz), (ixz, iyz, izz))
        # M_p,omega = -[h]x, carried to chi: R (-[h]x) W.
        minus_h: Mat3 = ((0.0, hz, -hy), (-hz, 0.0, hx), (hy, -hx, 0.0))
        p_q = mat_mat(rotation, mat_mat(minus_h, w))
        inertia_w = mat_mat(inertia, w)
        q_q = mat_mat(transpose(w), inertia_w)
        p_a1, p_a2 = mat_vec(rotation, (px1, 0.0, pz1)), mat_vec(rotation, (px2, 0.0, pz2))
        q_a1, q_a2 = vec_mat((w11, w21, w31), w), vec_mat((w12, w22, w32), w)

        # C chi' = T' (c + M [0; W' q'; 0]).
        extra = mat_vec(w_rate, q_rate)
        push = mat_vec(minus_h, extra)
        turn = mat_vec(inertia, extra)
        c_p = mat_vec(rotation, (fx + push[0], fy + push[1], fz + push[2]))
        c_q = vec_mat((nx + turn[0], ny + turn[1], nz + turn[2]), w)
        c1 += w11 * extra[0] + w21 * extra[1] + w31 * extra[2]
        c2 += w12 * extra[0] + w22 * extra[1] + w32 * extra[2]
        g_q = vec_mat((hy * up[2] - hz * up[1], hz * up[0] - hx * up[2], hx * up[1] - hy * up[0]), w)

        mt = self._total_kg
        mass: Matrix = (
            (mt, 0.0, 0.0, *p_q[0], p_a1[0], p_a2[0]),
            (0.0, mt, 0.0, *p_q[1], p_a1[1], p_a2[1]),
            (0.0, 0.0, mt, *p_q[2], p_a1[2], p_a2[2]),
            (p_q[0][0], p_q[1][0], p_q[2][0], *q_q[0], q_a1[0], q_a2[0]),
            (p_q[0][1], p_q[1][1], p_q[2][1], *q_q[1], q_a1[1], q_a2[1]),
            (p_q[0][2], p_q[1][2], p_q[2][2], *q_q[2], q_a1[2], q_a2[2]),
            (*p_a1, *q_a1, m11 + self._armature_1, m12),
            (*p_a2, *q_a2, m12, m22 + self._armature_2),
        )
        coriolis: Chi = (*c_p, *c_q, c1, c2)
        gravity: Chi = (0.0, 0.0, mt * GRAVITY_M_S2, *g_q, g1, g2)
        return DynamicsTerms(mass, coriolis, gravity)

    def _parts(self, angle_rad: Joints, rate_rad_s: Joints) -> tuple[_Part, _Part, _Part]:
        """Return link 1, link 2, and sensor with net at the end of link 2."""
        a1 = angle_rad[0]
        b = a1 - angle_rad[1]
        s1, c1, s2, c2 = math.sin(a1), math.cos(a1), math.sin(b), math.cos(b)
        rate_1, rate_2 = rate_rad_s[0], rate_rad_s[0] - rate_rad_s[1]
        x0, _, z0 = self._shoulder
        q1, q2 = rate_1 * rate_1, rate_2 * rate_2
        com, length = self._c1, self._l1
        link1 = _Part(
            self._m1,
            x0 + com * c1,
            z0 - com * s1,
            (-com * s1, 0.0),
            (-com * c1, 0.0),
            -com * c1 * q1,
            com * s1 * q1,
            (1.0, 0.0),
            rate_1,
            *_rod(self._m1, length, c1, s1, self._scale),
        )
        ball = self._tool_inertia
        link2, tool = (
            _Part(
                mass,
                x0 + length * c1 + out * c2,
                z0 - length * s1 - out * s2,
                (-length * s1 - out * s2, out * s2),
                (-length * c1 - out * c2, out * c2),
                -length * c1 * q1 - out * c2 * q2,
                length * s1 * q1 + out * s2 * q2,
                (1.0, -1.0),
                rate_2,
                *inertia,
            )
            for mass, out, inertia in (
                (self._m2, self._c2, _rod(self._m2, self._l2, c2, s2, self._scale)),
                (self._tool_kg, self._l2, (ball, ball, ball, 0.0)),
            )
        )
        return link1, link2, tool


def _rod(mass_kg: float, length_m: float, c: float, s: float, scale: float) -> _Vec4:
    """Return xx, yy, zz, xz of a rod along (c, 0, -s) in body axes."""
    across = mass_kg * length_m * length_m / 12.0
    axial = ROD_AXIAL_SHARE * across + scale * ROD_AXIAL_KG_M2
    return (axial * c * c + across * s * s, across, axial * s * s + across * c * c, (across - axial) * c * s)
