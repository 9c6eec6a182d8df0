"""Handling of the vehicle on the ground: carrying it through the guided hand test, tapping it, and hanging a weight on its net.

The operator's hand is modelled as a spring and a damper on the base; it also sways. The hand repeats one round (lift, forward, turn
left, back) with pauses in between, or it lifts and holds the vehicle while a second hand taps it. It acts only while the vehicle is
disarmed.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from companion.model.algebra import cross, plus
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import (
    quat_conjugate,
    quat_from_euler_zyx,
    quat_multiply,
    quat_rotate,
    yaw_from_quat,
)
from companion.model.types import Quat, Vec3
from companion.sitl_config.world import World as WorldConfig

STIFFNESS_N_M, DAMPING_NS_M = 900.0, 95.0
TURN_STIFFNESS_NM, TURN_DAMPING_NMS = 40.0, 4.0
LIFT_M, FORWARD_M, TURN_DEG = 0.30, 0.30, 45.0
REST_S = 6.0
"""Time on the floor between two rounds."""
_GRIP_S = 0.4
"""Time in which the hand takes up the weight, and in which it releases it."""
SWAY_DEG, SWAY_M = 2.0, 0.004


class _Leg(NamedTuple):
    duration_s: float
    forward_m: float
    up_m: float
    turn_deg: float
    """Target yaw relative to the yaw at the start of the round."""


_LEGS: Final = (
    _Leg(_GRIP_S, 0.0, 0.0, 0.0),
    _Leg(1.6, 0.0, LIFT_M, 0.0),
    _Leg(1.5, 0.0, LIFT_M, 0.0),
    _Leg(1.6, FORWARD_M, LIFT_M, 0.0),
    _Leg(1.5, FORWARD_M, LIFT_M, 0.0),
    _Leg(1.6, FORWARD_M, LIFT_M, TURN_DEG),
    _Leg(1.5, FORWARD_M, LIFT_M, TURN_DEG),
    _Leg(1.6, FORWARD_M, LIFT_M, 0.0),
    _Leg(1.6, 0.0, LIFT_M, 0.0),
    _Leg(2.0, 0.0, 0.0, 0.0),
    _Leg(_GRIP_S, 0.0, 0.0, 0.0),
)
ROUND_S: Final = sum(leg.duration_s for leg in _LEGS)
TAP_S: Final = 0.024
"""Duration of a tap with the flat hand; its force is half a period of a sine."""
TAP_EVERY_S: Final = 1.1
_HELD_S: Final = _GRIP_S + 1.6
"""Time from the grip until the vehicle is steady enough to be tapped."""
_TAP_LEVER_BODY_M: Vec3 = (0.06, 0.04, 0.02)
_TAPS_WORLD: Final[tuple[Vec3, ...]] = (
    (1.0, 0.0, 0.0),
    (0.0, 1.0, 0.0),
    (-0.8, 0.6, 0.0),
    (0.0, -0.8, 0.6),
    (-0.6, -0.6, 0.5),
)


class Wrench(NamedTuple):
    """Force and torque on the centre of mass of the base, world frame."""

    force_n: Vec3
    torque_nm: Vec3


class Handling:
    """Computes the force and torque that handling applies to the vehicle.

    Args:
        config: configuration of the world; `handling_t_s`, `handling_taps`, `handling_tap_n`, and `seed` for the hand's sway are used.
    """

    def __init__(self, config: WorldConfig, weight_n: float) -> None:
        self._weight_n = weight_n
        self._from_s = config.handling_t_s
        self._taps, self._tap_n = config.handling_taps, config.handling_tap_n
        self._legs = _LEGS if not self._taps else _holding(self._taps * TAP_EVERY_S)
        self._round_s = sum(leg.duration_s for leg in self._legs)
        self._origin: tuple[Vec3, float] | None = None
        self._phases: list[float] = np.random.default_rng((config.seed, 17)).uniform(0.0, 2.0 * math.pi, 5).tolist()

    def wrench(self, t_s: float, q: list[float], v: list[float]) -> Wrench | None:
        """Return the present force and torque of the hand, or None while it does not hold the vehicle.

        Args:
            q: MuJoCo's qpos, which begins with the position and quaternion of the base (world frame).
            v: MuJoCo's qvel, which begins with the velocity (world frame) and angular rate (body frame) of the base.
        """
        t_s -= self._from_s
        if t_s < 0.0:
            return None
        t_s %= self._round_s + REST_S
        if t_s >= self._round_s:
            return None
        attitude: Quat = (q[3], q[4], q[5], q[6])
        if self._origin is None:
            self._origin = ((q[0], q[1], q[2]), yaw_from_quat(attitude))
        (x, y, z), yaw = self._origin
        forward, up, turn = self._goal(t_s)
        grip = min(1.0, t_s / _GRIP_S, (self._round_s - t_s) / _GRIP_S)
        # The sway grows with the height: on the floor there is none.
        loose = min(1.0, up / LIFT_M)
        sway = [loose * math.sin(2.0 * math.pi * (0.35 + 0.07 * k) * t_s + p) for k, p in enumerate(self._phases)]
        goal = (
            x + forward * math.cos(yaw) + SWAY_M * sway[0],
            y + forward * math.sin(yaw) + SWAY_M * sway[1],
            z + up + SWAY_M * sway[2],
        )
        tilt_rad = math.radians(SWAY_DEG)
        want = quat_from_euler_zyx(tilt_rad * sway[3], tilt_rad * sway[4], yaw + turn)
        fx, fy, fz = (
            grip * (STIFFNESS_N_M * (to - at) - DAMPING_NS_M * speed)
            for to, at, speed in zip(goal, q[0:3], v[0:3], strict=True)
        )
        w, ex, ey, ez = quat_multiply(quat_conjugate(attitude), want)
        k = 2.0 * TURN_STIFFNESS_NM * grip * (1.0 if w >= 0.0 else -1.0)
        d = TURN_DAMPING_NMS * grip
        torque = quat_rotate(attitude, (k * ex - d * v[3], k * ey - d * v[4], k * ez - d * v[5]))
        if self._taps:
            tx, ty, tz = self._tap(t_s)
            lever = quat_rotate(attitude, _TAP_LEVER_BODY_M)
            fx, fy, fz = fx + tx, fy + ty, fz + tz
            torque = plus(torque, cross(lever, (tx, ty, tz)))
        return Wrench(force_n=(fx, fy, fz + grip * self._weight_n), torque_nm=torque)

    def _tap(self, t_s: float) -> Vec3:
        """Return the present force of the taps in N, world frame; zero between taps."""
        count, since_s = divmod(t_s - _HELD_S - 0.5 * TAP_EVERY_S, TAP_EVERY_S)
        # Taps by hand are irregular.
        since_s -= 0.13 * (1.0 + math.sin(5.1 * count + self._phases[0]))
        if not 0.0 <= count < self._taps or not 0.0 <= since_s < TAP_S:
            return (0.0, 0.0, 0.0)
        x, y, z = _TAPS_WORLD[int(count) % len(_TAPS_WORLD)]
        size_n = self._tap_n * math.sin(math.pi * since_s / TAP_S)
        return (x * size_n, y * size_n, z * size_n)

    def _goal(self, t_s: float) -> tuple[float, float, float]:
        """Return the target pose of a round: forward and up in m, turn to the left in rad."""
        before = _Leg(0.0, 0.0, 0.0, 0.0)
        for leg in self._legs:
            if t_s < leg.duration_s:
                s = t_s / leg.duration_s
                s = s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)
                forward, up, turn = (a + s * (b - a) for a, b in zip(before[1:], leg[1:], strict=True))
                return forward, up, math.radians(turn)
            t_s -= leg.duration_s
            before = leg
        return 0.0, 0.0, 0.0


class HungWeight:
    """A known weight that is hung on the net while the force sensor is being read.

    Args:
        config: configuration of the world; `net_weight_kg` and `net_weight_t_s` are used.
    """

    def __init__(self, config: WorldConfig) -> None:
        self._weight_n, self._after_s = GRAVITY_M_S2 * config.net_weight_kg, config.net_weight_t_s
        self._read_since_s: float | None = None

    def pull_n(self, t_s: float, read: bool) -> float:
        """Return the downward force on the centre of the net in N.

        Args:
            read: whether the force sensor is being read; the weight hangs on the net once reading has lasted `net_weight_t_s`.
        """
        if not read:
            self._read_since_s = None
        elif self._read_since_s is None:
            self._read_since_s = t_s
        since_s = self._read_since_s
        return self._weight_n if since_s is not None and t_s - since_s >= self._after_s else 0.0


def _holding(held_s: float) -> tuple[_Leg, ...]:
    """Return the legs of a round that lifts the vehicle, holds it for `held_s` and puts it back."""
    up, held = _Leg(1.6, 0.0, LIFT_M, 0.0), _Leg(held_s, 0.0, LIFT_M, 0.0)
    return (_Leg(_GRIP_S, 0.0, 0.0, 0.0), up, held, _Leg(2.0, 0.0, 0.0, 0.0), _Leg(_GRIP_S, 0.0, 0.0, 0.0))
