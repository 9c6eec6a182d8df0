"""How near a ball comes to the rotors of the vehicle that moves to meet it. Pure.

The body is neither level nor at its reference: it lags and tilts (`Lag`). It is expected to go on from where it was measured last.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from typing import Final

from companion.config.airframe import Airframe
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import quat_from_euler_zyx, quat_rotate, yaw_from_quat
from companion.model.types import Vec3, VehicleState
from companion.phases.intercept.ball import Point
from companion.phases.intercept.lag import Lag
from companion.phases.intercept.motion import State

FAR_M: Final = 0.3
"""Distance from all rotors beyond which a ball passes them."""
FRESH_S: Final = 0.1
"""Age up to which PX4's estimate, moved on with its velocity, is used."""
UPRIGHT: Final = 0.3
"""Cosine of the tilt beyond which it is no attitude of a flight."""
SHARES = (0.0, 0.33, 0.67)
"""Places between two points of a path at which the distance is taken."""


def clearance_m(airframe: Airframe, places_body_m: Iterable[Vec3]) -> float:
    """Return the smallest distance of a ball's centre from the rotor disks, above, below or beside them, at most about `FAR_M`.

    Args:
        airframe: rotors.
        places_body_m: successive places of the ball, body frame.
    """
    layout, least_m, disk_m = airframe.rotor_layout, FAR_M, airframe.disk_radius_m
    rotors, reach_m = layout.positions_body_m, airframe.radius_m + layout.height_m + FAR_M
    for (x, y, z), (to_x, to_y, to_z) in pairwise(places_body_m):
        if math.hypot(x, y, z) > reach_m:
            continue
        for share in SHARES:
            ball_x, ball_y, ball_z = x + share * (to_x - x), y + share * (to_y - y), z + share * (to_z - z)
            for rotor_x, rotor_y, rotor_z in rotors:
                if (above_m := abs(ball_z - rotor_z)) < least_m:
                    beside_m = math.hypot(ball_x - rotor_x, ball_y - rotor_y) - disk_m
                    least_m = min(least_m, max(beside_m, above_m))
    return least_m


def places_body_m(
    measured: VehicleState | None,
    yaw_rad: float,
    t_s: float,
    now: State,
    lag: Lag,
    path: Iterable[Point],
    push_m_s2: Callable[[float], Vec3],
) -> Iterator[Vec3]:
    """Yield the places of a ball in the frame of the body that follows the reference.

    Args:
        measured: PX4's estimate; None if it is unknown. If it is unknown or old, the body is where the model says.
        yaw_rad: yaw of the reference.
        t_s: flight clock.
        now: motion of the reference now.
        lag: its lagging acceleration.
        path: the ball's predicted path.
        push_m_s2: acceleration of the reference at a time on the flight clock.
    """
    p, v, a = now.position_m, now.velocity_m_s, now.acceleration_m_s2
    (x, y, z), (slope_x, slope_y) = _body_m(p, lag), _slopes(lag, a)
    beside, lean_x, lean_y = (0.0, 0.0, 0.0), 0.0, 0.0
    if measured is not None and t_s - min(measured.position_stamp_s, measured.attitude_stamp_s) <= FRESH_S:
        age_s, (u, w, r) = t_s - measured.position_stamp_s, measured.velocity_world_m_s
        (mx, my, mz), (nx, ny, nz) = measured.position_world_m, quat_rotate(measured.attitude_wxyz, (0.0, 0.0, 1.0))
        beside = (mx + age_s * u - x, my + age_s * w - y, mz + age_s * r - z)
        if nz > UPRIGHT:
            lean_x, lean_y = nx / nz - slope_x, ny / nz - slope_y
            yaw_rad = yaw_from_quat(measured.attitude_wxyz)
    unyawed = quat_from_euler_zyx(0.0, 0.0, -yaw_rad)
    for point in path:
        if (h := point.t_s - t_s) > 0.0:
            a = push_m_s2(point.t_s)
            v = (v[0] + h * a[0], v[1] + h * a[1], v[2] + h * a[2])
            t_s, p, lag = point.t_s, (p[0] + h * v[0], p[1] + h * v[1], p[2] + h * v[2]), lag.after(h, a)
        (x, y, z), (u, w), (mx, my, mz) = point.position_m, lag.body_m(), beside
        x, y, z = x - (p[0] + u) - mx, y - (p[1] + w) - my, z - p[2] - mz
        slope_x, slope_y = _slopes(lag, a)
        nx, ny = slope_x + lean_x, slope_y + lean_y
        nz = 1.0 / math.hypot(nx, ny, 1.0)
        nx, ny = nx * nz, ny * nz
        up = nx * x + ny * y + nz * z
        # The least rotation that levels the body.
        share = (up + z) / (1.0 + nz)
        yield quat_rotate(unyawed, (x - share * nx, y - share * ny, up))


def _body_m(reference_m: Vec3, lag: Lag) -> Vec3:
    u, v = lag.body_m()
    return (reference_m[0] + u, reference_m[1] + v, reference_m[2])


def _slopes(lag: Lag, acceleration_m_s2: Vec3) -> tuple[float, float]:
    """Return the slopes of the body's tilt: the more it rises, the less it tilts for the same acceleration."""
    x, y = lag.slopes()
    share = GRAVITY_M_S2 / max(1.0, GRAVITY_M_S2 + acceleration_m_s2[2])
    return x * share, y * share
