"""Masses and geometry of a serial arm of revolute joints with any axes.

Every link has a frame whose origin lies on the axis of the link's joint. At joint angle 0, the frame has the position and attitude of
the link's record in the frame of the link before or, for the first link, in the body frame; it turns about its joint's axis.
"""

from __future__ import annotations

from dataclasses import dataclass

from companion.model.types import IDENTITY_QUAT, Mat3, Quat, Vec3

ROD_AXIAL_SHARE = 0.1
ROD_AXIAL_KG_M2 = 1e-5
"""Inertia of a rod about its own axis: a fraction of the transverse inertia plus this constant."""
TOOL_PART_INERTIA_KG_M2 = 1e-4
"""Inertia of the sensor and of the net about any axis, kg m^2."""


@dataclass(frozen=True, slots=True)
class ChainLink:
    """A joint and the link that it turns."""

    position_m: Vec3
    """Position of the joint in the frame of the link before."""
    attitude_wxyz: Quat
    """Attitude of the link's frame at joint angle 0 in the frame of the link before."""
    axis: Vec3
    """Unit vector of the joint's axis in the link's frame; positive angles turn the link about it by the right-hand rule."""
    mass_kg: float
    com_m: Vec3
    """Centre of mass in the link's frame."""
    inertia_kg_m2: Mat3
    """Inertia about the centre of mass, in the axes of the link's frame."""
    armature_kg_m2: float
    """Inertia of the servo's rotor and gears, referred to the joint."""


@dataclass(frozen=True, slots=True)
class ArmChain:
    """An arm, from the body outwards. Without links, there is no arm, and the tip is a point of the body."""

    links: tuple[ChainLink, ...]
    tip_m: Vec3 = (0.0, 0.0, 0.0)
    """Tip in the frame of the last link: the centre of the net or, without a tool, the end of the arm."""
    tip_wxyz: Quat = IDENTITY_QUAT
    """Attitude of the tip's frame in the frame of the last link; the tip's x axis points outwards."""
    sensor_wxyz: Quat = IDENTITY_QUAT
    """Attitude of the force-torque sensor's frame in the frame of the last link."""
    tool_mass_kg: float = 0.0
    """Mass of the force-torque sensor and the net, which is at the tip."""
    tool_inertia_kg_m2: float = 0.0
    """Inertia of the tool about any axis through the tip."""


def rod_inertia_kg_m2(mass_kg: float, length_m: float) -> Vec3:
    """Return the moments of inertia of a rod along x about the x, y and z axes through its centre of mass."""
    across = mass_kg * length_m * length_m / 12.0
    return (ROD_AXIAL_SHARE * across + ROD_AXIAL_KG_M2, across, across)


def is_physical_inertia(inertia_kg_m2: Mat3) -> bool:
    """Return whether a symmetric matrix is the inertia of a rigid body: no principal moment is negative or exceeds the sum of the other
    two. That holds if and only if I_trace / 2 - I, the second moment of the mass, has no negative principal minor.
    """
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = inertia_kg_m2
    half = 0.5 * (xx + yy + zz)
    a, b, c, d, e, f = half - xx, half - yy, half - zz, -xy, -xz, -yz
    slack = 1e-6 * half
    determinant = a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
    return (
        half > 0.0
        and min(a, b, c) >= -slack
        and min(a * b - d * d, a * c - e * e, b * c - f * f) >= -slack * half
        and determinant >= -slack * half * half
    )
