"""The bar that two vehicles carry, as the mission describes it: where it stands, its ends, and its planned motion."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Annotated, Final, Literal

from pydantic import Field

from companion.config.base import Model, NonNegative, Positive, Vector2
from companion.config.vehicle import Vehicle
from companion.control.manipulator import Manipulator
from companion.mission.phase import Phase
from companion.model.frames import quat_from_euler_zyx, quat_rotate
from companion.model.types import Joints, Vec3

End = Literal["left", "right"]
"""The end of the bar that a vehicle holds. The bar's yaw is that of the direction from its right to its left end; the first member of a
team has the left one."""


HANDLE_BELOW_M: Final = 0.1
"""Least distance of a standing bar's handles below the rotors of a vehicle that stands, too."""


class Bar(Model):
    """A straight bar on feet, with a spherical handle at each end."""

    length_m: Annotated[float, Field(ge=0.3, le=3.0)]
    """Distance between the centres of the handles."""
    handle_height_m: Positive
    """Height of the handles above the floor while the bar stands on its feet."""
    mass_max_kg: NonNegative
    """Largest expected mass; each vehicle lifts half of it, and somewhat more if the centre of mass is off the middle."""
    position_m: Vector2
    """Middle of the bar before it is lifted, world frame."""
    yaw_deg: Annotated[float, Field(ge=-360, le=360)]
    """Yaw before it is lifted."""


class BarPose:
    """Pose of the level bar.

    Args:
        centre_m: middle between the handles, world frame.
        yaw_rad: yaw.
    """

    def __init__(self, centre_m: Vec3, yaw_rad: float) -> None:
        self.centre_m, self.yaw_rad = centre_m, yaw_rad


def sign_of(end: End) -> float:
    """Return 1 for the left end, which is in the direction of the bar's yaw, and -1 for the right one."""
    return 1.0 if end == "left" else -1.0


def vehicle_yaw_rad(bar_yaw_rad: float, end: End) -> float:
    """Return the yaw of the vehicle at one end: it looks at the other."""
    return bar_yaw_rad + (math.pi if end == "left" else 0.0)


def body_in_bar_m(manipulator: Manipulator, end: End, bar: Bar, arm_rad: Joints) -> Vec3:
    """Return the place of the body's origin whose clamp holds an end, relative to the middle of the bar, in the bar's frame."""
    turned = quat_from_euler_zyx(0.0, 0.0, vehicle_yaw_rad(0.0, end))
    x, y, z = quat_rotate(turned, manipulator.net_body_m(arm_rad))
    return (sign_of(end) * 0.5 * bar.length_m - x, -y, -z)


def turned_about_z(vector: Vec3, yaw_rad: float) -> Vec3:
    """Return a vector turned about the vertical."""
    c, s, (x, y, z) = math.cos(yaw_rad), math.sin(yaw_rad), vector
    return (c * x - s * y, s * x + c * y, z)


def body_m(pose: BarPose, in_bar_m: Vec3) -> Vec3:
    """Return the place of the body's origin, world frame, from its place in the bar's frame."""
    (cx, cy, cz), (x, y, z) = pose.centre_m, turned_about_z(in_bar_m, pose.yaw_rad)
    return (cx + x, cy + y, cz + z)


def problems_of(vehicle: Vehicle, bar: Bar) -> Iterator[str]:
    """Yield the reasons why this vehicle cannot hold an end of this bar."""
    if vehicle.jaws is None:
        yield f"holds a bar, but vehicle '{vehicle.name}' has no clamp (tool.kind: clamp)"
        return
    if vehicle.devices.force is None:
        yield f"carries a bar by the measured force, but vehicle '{vehicle.name}' has no force sensor (devices.force)"
    airframe = vehicle.airframe
    rotors_m = airframe.ground_clearance_m + min(z for _, _, z in airframe.rotor_layout.positions_body_m)
    if bar.handle_height_m > rotors_m - HANDLE_BELOW_M:
        yield (
            f"grips handles {bar.handle_height_m:g} m above the floor, into which the rotors of a vehicle that PX4 lands there would "
            f"descend (to {rotors_m:g} m); make the feet shorter: at most {rotors_m - HANDLE_BELOW_M:.2f} m"
        )
    if bar.mass_max_kg > 2.0 * vehicle.airframe.payload_max_kg:
        yield (
            f"lifts half of a bar of {bar.mass_max_kg:g} kg, but vehicle '{vehicle.name}' carries at most "
            f"{vehicle.airframe.payload_max_kg:g} kg (airframe.payload_max_kg)"
        )


def grip_before(phases: Sequence[Phase]) -> Phase | None:
    """Return the newest phase of type `grip`, or None."""
    return next((phase for phase in reversed(phases) if phase.type == "grip"), None)
