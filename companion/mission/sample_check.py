"""Checks one instant of a plan against every limit: the room, the tether, the floor, the joints, the motion and the thrust.

Pure. A position is checked with the expected tracking error (`TRACKING_M`, more around a catch), and so is the position where the
vehicle would come to rest after a fault. The check uses the governor's own `SafeSet` and is stricter, so the governor never constrains
a plan without violations.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from companion.config.arm import LINK_RADIUS_M
from companion.config.mission import Mission
from companion.config.vehicle import Vehicle
from companion.control.arm_model import manipulator_of
from companion.mission.arm_check import ArmCheck
from companion.mission.violation import TOLERANCE, Violation
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import quat_from_euler_zyx
from companion.model.types import Joints, PhaseKind, Quat, Reference, Vec3
from companion.safety.governor import BODY_TOP_M, SafeSet
from companion.safety.stop import StopModel
from companion.safety.tether import TetherWatch

TRACKING_M = 0.10
"""Largest expected distance from the plan, m; measured over random missions in a wind of 3 m/s."""
CATCH_M = 0.20
"""Largest expected distance from the plan from the catch until the impact has decayed, m."""
CATCH_NEAR_M = 0.05
"""Largest horizontal distance from the expected place at which the catch can happen, m."""
CATCH_S = 2.0
THRUST_SHARE_MAX = 0.9
"""Upper bound on `limits.thrust_share_max`; the rest is reserved for attitude control."""
STOP = "stop "
"""Prefix of a limit's name if the planned position respects the limit, but the position where the vehicle would come to rest does not.
"""


class SampleCheck:
    """Checks consecutive instants of a plan against every limit.

    Raises:
        ValueError: vehicle, tether and room leave no space to fly in; the text is one line.
    """

    def __init__(self, mission: Mission, vehicle: Vehicle) -> None:
        self._limits = mission.limits
        self._catch = mission.catch
        self._vehicle = vehicle
        self._arm = ArmCheck(vehicle)
        self._manipulator = manipulator_of(vehicle)
        self._safe = SafeSet(vehicle)
        self._stop_model = StopModel(vehicle.safety)
        self._watch = TetherWatch.of(vehicle)
        airframe, tether = vehicle.airframe, vehicle.tether
        self._payload_kg = airframe.payload_max_kg if mission.catch is None else mission.catch.payload_max_kg
        if not vehicle.has_net:
            self._payload_kg = 0.0
        self._tether_n = 0.0 if tether is None else tether.weight_n_per_m * tether.length_m
        self._blow_until_s = 0.0
        """Time at which the catch's impact has decayed; 0 before the catch. Passing the same place again is not a catch."""
        self._repetition = 0
        self._windings: list[tuple[float, float]] = []
        """Turns about anchor and vehicle during the second repetition."""

    def begin_repetition(self, repetition: int) -> None:
        """Start a repetition, counted from 1, with a catch of its own; 0 is the part that is flown once."""
        self._repetition = repetition
        self._blow_until_s = 0.0

    def turns_in_the_end(self, repetitions: int) -> float:
        """Return the most turns of the tether in the last repetition; each after the second winds it as much as the second."""
        if not self._windings:
            return 0.0
        most = 0.0
        for turns in zip(*self._windings, strict=True):
            further = (repetitions - 2) * (turns[-1] - turns[0])
            most = max(most, *(abs(value + further) for value in turns))
        return most

    def violations(
        self, t_s: float, reference: Reference, jerks: tuple[Vec3, Joints], kind: PhaseKind
    ) -> Iterator[Violation]:
        """Return the violations at one instant. Instants must be passed in chronological order.

        Args:
            t_s: time on the plan's clock.
            jerks: jerk of the vehicle, world frame, m/s^3, and of the joints, rad/s^3.
        """
        clearance_m = self._vehicle.airframe.ground_clearance_m
        x_m, y_m, z_m = reference.position_world_m
        if kind is PhaseKind.LANDING and z_m < clearance_m:
            return  # the reference continues below the floor until touchdown is detected
        if kind is PhaseKind.FLIGHT and z_m < clearance_m - TOLERANCE:
            yield Violation(
                limit="floor",
                excess=clearance_m - z_m,
                what="flies into the floor",
                detail=f"the body's origin at {z_m:.2f} m (minimum {clearance_m:.2f} m)",
                advice="raise the waypoint",
            )
        position = (x_m, y_m, max(z_m, clearance_m)) if kind is PhaseKind.TAKEOFF else reference.position_world_m
        off_m = self._off_m(t_s, position, kind)
        yield from self._space(position, reference, off_m)
        yield from self._stop(position, reference, kind, off_m)
        yield from self._line(t_s, position, reference)
        yield from self._arm.violations(position, reference)
        yield from self._motion(reference, jerks)
        yield from self._thrust(reference)

    def _off_m(self, t_s: float, position: Vec3, kind: PhaseKind) -> float:
        """Return the largest expected distance from the plan at this instant, m."""
        if self._catch is not None and kind is PhaseKind.FLIGHT and not 0.0 < self._blow_until_s <= t_s:
            if math.dist(position[:2], self._catch.expected_at_m) <= CATCH_NEAR_M:
                self._blow_until_s = t_s + CATCH_S
        return CATCH_M if t_s < self._blow_until_s else TRACKING_M

    def _space(self, position: Vec3, reference: Reference, off_m: float) -> Iterator[Violation]:
        vehicle = self._vehicle
        points = [(position, 0.0)]
        if vehicle.arm.joints:
            arm_rad, yaw_rad = reference.arm_rad, reference.yaw_rad
            points = [(_world(position, yaw_rad, self._manipulator.net_body_m(arm_rad)), vehicle.tip_radius_m)]
            for joint_m in self._manipulator.joints_body_m(arm_rad):
                points.append((_world(position, yaw_rad, joint_m), LINK_RADIUS_M))
        radius_m = vehicle.airframe.radius_m
        room = vehicle.room
        why = _allowance(off_m)
        parts = (
            f"the rotors, the arm and the {vehicle.tool.kind if vehicle.tool is not None else 'net'}"
            if vehicle.arm.joints
            else "the rotors"
        )
        for axis, name, span in ((0, "x", room.x_m), (1, "y", room.y_m), (2, "z", room.z_m)):
            if axis == 2 and position[2] < vehicle.airframe.ground_clearance_m:
                continue  # reported as flying into the floor
            low = position[2] + off_m
            if axis < 2:
                low = min(position[axis] - radius_m, *(point[axis] - around_m for point, around_m in points))
            body = position[axis] + (radius_m if axis < 2 else BODY_TOP_M)
            high = max(body, *(point[axis] + around_m for point, around_m in points))
            for edge, excess, reach in (("low", span[0] - low + off_m, low), ("high", high + off_m - span[1], high)):
                if excess > TOLERANCE:
                    yield Violation(
                        limit=f"room {name} {edge}",
                        excess=excess,
                        what="leaves the room",
                        detail=f"{parts} reach {name} = {reach:.2f} m; "
                        f"the room is {span[0]:g} to {span[1]:g} m, reduced at each end by {why}",
                        advice="move the waypoint inwards",
                    )
        beyond_m = self._safe.breach_tether_m(position) + off_m
        if beyond_m > TOLERANCE:
            limit_m = self._safe.radius_m - off_m
            yield Violation(
                limit="tether",
                excess=beyond_m,
                what="leaves the tether sphere",
                detail=f"{limit_m + beyond_m:.2f} m from the anchor (limit {limit_m:.2f} m: length minus margin and {why})",
                advice="shorten the line or move the anchor",
            )

    def _stop(self, position: Vec3, reference: Reference, kind: PhaseKind, off_m: float) -> Iterator[Violation]:
        """Check the position where the vehicle would come to rest after a fault at this instant, with the same tracking error as the
        position itself.

        The monitors use the measured velocity, and must not stop a flight with a small tracking error.
        """
        safe = self._safe
        speed = math.hypot(*reference.velocity_world_m_s)
        stop_s = self._stop_model.time_s(speed)
        x_m, y_m, z_m = (p + v * stop_s for p, v in zip(position, reference.velocity_world_m_s, strict=True))
        floor_m = self._vehicle.airframe.ground_clearance_m
        if kind is PhaseKind.LANDING:
            z_m = max(z_m, floor_m)  # a landing ends on the floor
        stop = (x_m, y_m, z_m)
        less = f" with {_allowance(off_m)}"
        found = (
            ("tether", "tether sphere", safe.breach_tether_m(stop) - max(-off_m, safe.breach_tether_m(position)), less),
            ("room", "room", safe.breach_walls_m(stop) - max(-off_m, safe.breach_walls_m(position)), less),
            ("floor", "height above the floor", min(floor_m, position[2]) - z_m, ""),
        )
        for limit, what, beyond_m, with_m in found:
            if beyond_m > TOLERANCE:
                yield Violation(
                    limit=f"{STOP}{limit}",
                    excess=beyond_m,
                    what=f"could not stop within the {what}",
                    detail=f"at {speed:.2f} m/s the vehicle needs {speed * stop_s:.2f} m to stop, {beyond_m:.2f} m too far{with_m}",
                    advice="fly more slowly towards the edge or turn back earlier",
                )

    def _line(self, t_s: float, position: Vec3, reference: Reference) -> Iterator[Violation]:
        """Check the tether itself: whether it is wound up or too close to the rotors or the arm."""
        tether, watch = self._vehicle.tether, self._watch
        if tether is None or watch is None:
            return
        attitude = _leaning(reference)
        state = watch.update(t_s, position, reference.velocity_world_m_s, attitude, reference.arm_rad, None, None)
        if self._repetition == 2:
            self._windings.append(watch.windings)
        if abs(state.turns) > tether.turns_max:
            detail = f"{abs(state.turns):.2f} turns about the anchor or the vehicle (tether.turns_max is {tether.turns_max:g})"
            yield Violation(
                limit="turns",
                excess=abs(state.turns),
                what="winds up the tether",
                detail=detail,
                advice="fly back the way it came, or turn the other way",
            )
        if state.clearance_m < tether.clearance_min_m:
            detail = (
                f"{state.clearance_m:.3f} m between the line and the rotors or the arm "
                f"(tether.clearance_min_m is {tether.clearance_min_m:g}; the anchor is seen "
                f"{math.degrees(state.elevation_rad):.0f} deg below the horizon)"
            )
            advice = "fly higher or nearer to the anchor, accelerate less, or tie the tether elsewhere"
            yield Violation(
                limit="line",
                excess=tether.clearance_min_m - state.clearance_m,
                what="brings the tether too close to the rotors or the arm",
                detail=detail,
                advice=advice,
            )

    def _motion(self, reference: Reference, jerks: tuple[Vec3, Joints]) -> Iterator[Violation]:
        limits = self._limits
        speed = math.hypot(*reference.velocity_world_m_s)
        acceleration = math.hypot(*reference.acceleration_world_m_s2)
        arm_speed = math.degrees(max(map(abs, reference.arm_rate_rad_s), default=0.0))
        arm_acceleration = math.degrees(max(map(abs, reference.arm_acceleration_rad_s2), default=0.0))
        jerk = math.hypot(*jerks[0])
        arm_jerk = math.degrees(max(map(abs, jerks[1]), default=0.0))
        checked = (
            ("speed_max_m_s", speed, limits.speed_max_m_s, "m/s", "flies too fast"),
            ("acceleration_max_m_s2", acceleration, limits.acceleration_max_m_s2, "m/s^2", "accelerates too hard"),
            ("jerk_max_m_s3", jerk, limits.jerk_max_m_s3, "m/s^3", "starts or stops too abruptly"),
            ("arm_speed_max_deg_s", arm_speed, limits.arm_speed_max_deg_s, "deg/s", "turns a joint too fast"),
            (
                "arm_acceleration_max_deg_s2",
                arm_acceleration,
                limits.arm_acceleration_max_deg_s2,
                "deg/s^2",
                "accelerates a joint too hard",
            ),
            ("arm_jerk_max_deg_s3", arm_jerk, limits.arm_jerk_max_deg_s3, "deg/s^3", "jerks a joint"),
        )
        for key, value, limit, unit, what in checked:
            if value > limit * (1.0 + TOLERANCE):
                detail = f"{value:.3g} {unit} (limits.{key} is {limit:g})"
                yield Violation(
                    limit=key,
                    excess=value / limit,
                    what=what,
                    detail=detail,
                    advice="allow more time or shorten the move",
                )
        for number, joint in enumerate(self._vehicle.arm.joints, start=1):
            rate = abs(math.degrees(reference.arm_rate_rad_s[number - 1]))
            if rate > joint.velocity_max_deg_s * (1.0 + TOLERANCE):
                what = f"turns joint {number} faster than it can"
                detail = f"{rate:.3g} deg/s (the joint's velocity_max_deg_s is {joint.velocity_max_deg_s:g})"
                yield Violation(
                    limit=f"velocity {number}",
                    excess=rate,
                    what=what,
                    detail=detail,
                    advice="allow more time or shorten the move",
                )

    def _thrust(self, reference: Reference) -> Iterator[Violation]:
        limits, airframe = self._limits, self._vehicle.airframe
        ax, ay, az = reference.acceleration_world_m_s2
        mass_kg = airframe.mass_kg + self._payload_kg
        thrust_n = mass_kg * math.hypot(ax, ay, az + GRAVITY_M_S2) + self._tether_n
        share = min(limits.thrust_share_max, THRUST_SHARE_MAX)
        allowed_n = share * airframe.thrust_max_n
        if thrust_n > allowed_n * (1.0 + TOLERANCE):
            carried = f"{self._payload_kg:g} kg of payload" + (" and the tether's weight" if self._tether_n else "")
            detail = (
                f"{thrust_n:.1f} N with {carried} (limit {allowed_n:.1f} N: {share:g} of {airframe.thrust_max_n:g} N)"
            )
            yield Violation(
                limit="thrust",
                excess=thrust_n,
                what="needs too much thrust",
                detail=detail,
                advice="allow more time or carry less",
            )
        tilt_deg = math.degrees(math.atan2(math.hypot(ax, ay), az + GRAVITY_M_S2))
        if tilt_deg > airframe.tilt_max_deg * (1.0 + TOLERANCE):
            detail = f"{tilt_deg:.1f} deg (airframe.tilt_max_deg is {airframe.tilt_max_deg:g})"
            yield Violation(
                limit="tilt",
                excess=tilt_deg,
                what="tilts too far",
                detail=detail,
                advice="allow more time or shorten the move",
            )


def _allowance(off_m: float) -> str:
    return f"{off_m:g} m for {'the catch' if off_m == CATCH_M else 'tracking'}"


def _leaning(reference: Reference) -> Quat:
    """Return the attitude of a vehicle that accelerates as the reference does."""
    ax, ay, az = reference.acceleration_world_m_s2
    c, s = math.cos(reference.yaw_rad), math.sin(reference.yaw_rad)
    ahead, left, up = c * ax + s * ay, c * ay - s * ax, az + GRAVITY_M_S2
    return quat_from_euler_zyx(-math.atan2(left, math.hypot(ahead, up)), math.atan2(ahead, up), reference.yaw_rad)


def _world(position: Vec3, yaw_rad: float, body_m: Vec3) -> Vec3:
    """Transform a point of the level vehicle to the world frame."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    x_m, y_m, z_m = body_m
    return (position[0] + c * x_m - s * y_m, position[1] + s * x_m + c * y_m, position[2] + z_m)
