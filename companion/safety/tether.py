"""The safety tether: slack now and at the predicted stop, clearance from the rotors and the arm, winding, pull, separation. No I/O.

The tether is a line, no longer than `tether.length_m`, between its anchor and an attachment point on the vehicle. Unmeasured
quantities are bounded: the shape of the line (`companion.safety.tether_shape`) and its pull (`companion.safety.tether_pull`). Plain
floats: the watch runs in the control tick.
"""

from __future__ import annotations

import math
from typing import Final

from companion.config.tether import Tether
from companion.config.vehicle import Vehicle
from companion.model.frames import quat_rotate
from companion.model.outputs import TetherState
from companion.model.types import Joints, Quat, Vec3
from companion.safety.stop import StopModel
from companion.safety.tether_pull import PullEstimate
from companion.safety.tether_shape import Clearance, steepest_slope

_TWO_PI: Final = 2.0 * math.pi
_ABOVE_M: Final = 0.05
"""Distance to a vertical below which the direction to it is undefined and the winding stays unchanged."""
_DT_MAX_S: Final = 0.05
"""Longest time step of the filters; a longer gap between two updates counts as this."""


def attachment_world_m(tether: Tether, position_world_m: Vec3, attitude_wxyz: Quat) -> Vec3:
    """Return the tether's attachment point on the vehicle, world frame, m."""
    x, y, z = quat_rotate(attitude_wxyz, tether.attachment_body_m)
    return (position_world_m[0] + x, position_world_m[1] + y, position_world_m[2] + z)


def distance_m(tether: Tether, position_world_m: Vec3, attitude_wxyz: Quat) -> float:
    """Return the straight distance from the anchor to the attachment point."""
    return math.dist(attachment_world_m(tether, position_world_m, attitude_wxyz), tether.anchor_world_m)


def slack_m(tether: Tether, position_world_m: Vec3, attitude_wxyz: Quat) -> float:
    """Return the tether length that is left, m; 0 if the tether is taut."""
    return tether.length_m - distance_m(tether, position_world_m, attitude_wxyz)


class Winding:
    """Counts the turns of a direction, starting at the first direction given."""

    __slots__ = ("_last_rad", "turns")

    def __init__(self) -> None:
        self._last_rad: float | None = None
        self.turns = 0.0

    def update(self, x: float, y: float) -> float:
        """Update with the direction (x, y), m, and return the turns. A vector shorter than `_ABOVE_M` changes nothing."""
        if x * x + y * y < _ABOVE_M * _ABOVE_M:
            return self.turns
        angle = math.atan2(y, x)
        if self._last_rad is not None:
            step = angle - self._last_rad
            if step > math.pi:
                step -= _TWO_PI
            elif step < -math.pi:
                step += _TWO_PI
            self.turns += step / _TWO_PI
        self._last_rad = angle
        return self.turns


class TetherWatch:
    """Tracks the tether during a flight: winding, clearance and low-passed force.

    `TetherState.turns` is the larger of the windings of the vehicle about the anchor's vertical (flying round it) and of the line
    about the vehicle (yawing on the spot), counter-clockwise positive from above and counted from the first update.
    `clearance_m` counts the arm only if the line is not tied in the arm's own plane (`Clearance.judges_arm`).

    Args:
        vehicle: airframe, arm and tool.
        tether: the vehicle's tether.
    """

    def __init__(self, vehicle: Vehicle, tether: Tether) -> None:
        self._anchor = tether.anchor_world_m
        self._attachment = tether.attachment_body_m
        self._length_m = tether.length_m
        self._stop = StopModel(vehicle.safety)
        self._taut_slack_m = tether.taut_slack_m
        self._separation_m = tether.separation_m
        self._clearance = Clearance(vehicle, tether)
        self._pull = PullEstimate(tether)
        self._about_anchor = Winding()
        self._about_vehicle = Winding()
        self._last_t_s: float | None = None

    @classmethod
    def of(cls, vehicle: Vehicle) -> TetherWatch | None:
        """Return the watch of the vehicle's tether, or None if the vehicle has none."""
        return cls(vehicle, vehicle.tether) if vehicle.tether is not None else None

    @property
    def windings(self) -> tuple[float, float]:
        """Return the turns of the vehicle about the anchor's vertical, and those of the tether about the vehicle."""
        return self._about_anchor.turns, self._about_vehicle.turns

    def update(
        self,
        t_s: float,
        position_world_m: Vec3,
        velocity_world_m_s: Vec3,
        attitude_wxyz: Quat,
        arm_rad: Joints | None,
        disturbance_world_n: Vec3 | None,
        tool_force_world_n: Vec3 | None,
    ) -> TetherState:
        """Update with one tick and return the tether's state.

        Args:
            t_s: flight clock.
            position_world_m: position of the body's origin.
            velocity_world_m_s: velocity of the body's origin.
            attitude_wxyz: body-to-world rotation.
            arm_rad: joint angles as in the paper; if None, the arm is assumed to be anywhere within its reach.
            disturbance_world_n: force on the vehicle other than rotor thrust and gravity, N; None if unknown or on the ground.
            tool_force_world_n: the part of this force that acts on the net, with the bias removed, N; None if unknown.
        """
        dt_s = 0.0
        if self._last_t_s is not None:
            dt_s = t_s - self._last_t_s
            if not 0.0 <= dt_s <= _DT_MAX_S:
                dt_s = min(_DT_MAX_S, max(0.0, dt_s))
        self._last_t_s = t_s
        w, i, j, k = attitude_wxyz
        # Rows of the rotation body -> world.
        xx, xy, xz = 1.0 - 2.0 * (j * j + k * k), 2.0 * (i * j - w * k), 2.0 * (i * k + w * j)
        yx, yy, yz = 2.0 * (i * j + w * k), 1.0 - 2.0 * (i * i + k * k), 2.0 * (j * k - w * i)
        zx, zy, zz = 2.0 * (i * k - w * j), 2.0 * (j * k + w * i), 1.0 - 2.0 * (i * i + j * j)
        bx, by, bz = self._attachment
        ax, ay, az = self._anchor
        px, py, pz = position_world_m
        # From the attachment to the anchor.
        lx = ax - px - (xx * bx + xy * by + xz * bz)
        ly = ay - py - (yx * bx + yy * by + yz * bz)
        lz = az - pz - (zx * bx + zy * by + zz * bz)
        level_2 = lx * lx + ly * ly
        range_m = math.sqrt(level_2 + lz * lz)
        level_m = math.sqrt(level_2)
        slack = self._length_m - range_m
        scale = 1.0 / range_m if range_m > 1e-6 else 0.0
        ux, uy, uz = lx * scale, ly * scale, lz * scale
        vx, vy, vz = velocity_world_m_s
        outward = -(vx * ux + vy * uy + vz * uz)
        stop_slack = slack
        if outward > 0.0:
            stop_slack -= self._stop.distance_m(outward)

        # The line in the body's frame, straight and with the deepest sag that its length permits.
        straight = (xx * ux + yx * uy + zx * uz, xy * ux + yy * uy + zy * uz, xz * ux + yz * uy + zz * uz)
        hanging = None
        if self._clearance.needs_hanging and slack > 0.0:
            along, down = steepest_slope(level_m, lz, range_m, slack)
            hx, hy = (lx / level_m * along, ly / level_m * along) if level_m > 1e-6 else (0.0, 0.0)
            hanging = (xx * hx + yx * hy + zx * down, xy * hx + yy * hy + zy * down, xz * hx + yz * hy + zz * down)

        pull = self._pull
        pull.update(dt_s, (ux, uy, uz), velocity_world_m_s, disturbance_world_n, tool_force_world_n)
        used_up = slack <= self._taut_slack_m
        about_anchor = self._about_anchor.update(-lx, -ly)
        about_vehicle = self._about_vehicle.update(straight[0] * range_m, straight[1] * range_m)
        return TetherState(
            range_m=range_m,
            slack_m=slack,
            stop_slack_m=stop_slack,
            elevation_rad=math.atan2(-lz, level_m),
            clearance_m=self._clearance.least_m(straight, hanging, arm_rad),
            turns=about_anchor if abs(about_anchor) >= abs(about_vehicle) else about_vehicle,
            pull_n=max(0.0, pull.pull_n),
            taut=used_up,
            snagged=(pull.pulling or pull.sideways) and not used_up,
            separated=slack < -self._separation_m and not pull.pulling,
            vehicle_turns=0.0,
        )
