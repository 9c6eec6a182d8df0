"""The arm and the tool of the vehicle file."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, JsonValue, model_validator

from companion.config.base import (
    JOINTS_MAX,
    Axis,
    Location,
    Model,
    NonNegative,
    PerJoint,
    Positive,
    PositivePerJoint,
    Span,
    Vector3,
    refuse,
)
from companion.model.arm_chain import is_physical_inertia
from companion.model.servos import SERVOS, WITHOUT_CURRENT_CONTROL, ServoKind, ServoName, simulated_kind
from companion.model.types import Joints

FOLDED, UNFOLDED = "folded", "unfolded"
"""Names of poses that the shipped missions use."""


SPEED_USUAL_DEG_S = 300.0


def _with_current_control(name: object) -> object:
    if isinstance(name, str) and name in WITHOUT_CURRENT_CONTROL:
        raise ValueError(f"the {name} has no current control (operating mode 0), so that it cannot follow a torque")
    return name


def _speed_of_servo_deg_s(joint: dict[str, Any]) -> float:
    servo = joint.get("servo")  # absent if its name is invalid, None for another motor: both are reported elsewhere
    return SPEED_USUAL_DEG_S if servo is None else min(SPEED_USUAL_DEG_S, SERVOS[servo].speed_max_deg_s)


class Joint(Model):
    """One servo or motor and its joint, with angles as defined in the paper."""

    servo: Annotated[ServoName | None, BeforeValidator(_with_current_control)] = "XM430-W210"
    """Model of the Dynamixel servo; the driver refuses a servo of another model. null for a motor that a plug-in drives
    (docs/plug-ins.md)."""
    servo_id: Annotated[int, Field(ge=0, le=252)]
    """Id of the servo, or of the motor, on its bus."""
    sign: Literal[-1, 1]
    """1 if the servo's counts increase with the joint angle, -1 if they decrease."""
    zero_count: Annotated[int, Field(ge=-1048575, le=1048575)]
    """Present Position (register 132) at joint angle 0; of a motor that a plug-in drives, its angle in 1/4096 of a turn."""
    angle_deg: Span
    """Lower and upper joint limit; with a Dynamixel servo, less than 360 deg apart, because it loses its turns when it is switched
    off."""
    torque_max_nm: Positive
    """Largest commanded torque, at most the stall torque of the servo."""
    velocity_max_deg_s: Positive = Field(default_factory=_speed_of_servo_deg_s)
    """Largest planned speed, at most the speed of the servo without load; if it is absent, that speed or 300 deg/s, if it is less."""
    torque_per_amp_nm_a: Positive | None = None
    """Torque constant of this servo; null for the value of the arm."""
    armature_kg_m2: NonNegative | None = None
    """Inertia of this servo's rotor and gears, referred to the joint; null for the value of the arm."""
    axis: Axis | None = None
    """Direction of the axis in the link's frame, for arms without `links`. If it is absent, the first joint turns about +y and the
    others about -y.
    """

    @property
    def kind(self) -> ServoKind:
        """Return the data of the servo's model, or of the servo that the simulated world has in place of another motor."""
        if self.servo is None:
            return simulated_kind(self.torque_max_nm, self.velocity_max_deg_s / 6.0)
        return SERVOS[self.servo]

    @model_validator(mode="after")
    def _servo_suffices(self) -> Self:
        kind, problems = self.kind, list[tuple[Location, str]]()
        if self.servo is None:
            if "velocity_max_deg_s" not in self.model_fields_set:
                problems.append((("velocity_max_deg_s",), "missing; required if servo is null"))
            if self.torque_per_amp_nm_a is not None:
                problems.append((("torque_per_amp_nm_a",), "must be absent, because servo is null"))
            refuse("joint", problems)
            return self
        low_deg, high_deg = self.angle_deg
        if high_deg - low_deg >= 360.0:
            text = f"expected less than 360 deg between the limits, got {high_deg - low_deg:g} deg: the servo loses its turns"
            problems.append((("angle_deg",), f"{text} when it is switched off"))
        if self.torque_max_nm > kind.stall_torque_nm:
            text = f"the {kind.name} stalls at {kind.stall_torque_nm:g} N m, got {self.torque_max_nm:g} N m"
            problems.append((("torque_max_nm",), text))
        if self.velocity_max_deg_s > kind.speed_max_deg_s:
            text = f"the {kind.name} turns at most at {kind.speed_max_deg_s:g} deg/s, got {self.velocity_max_deg_s:g} deg/s"
            problems.append((("velocity_max_deg_s",), text))
        refuse("joint", problems)
        return self


class Link(Model):
    """A link in the general description of an arm. Its frame lies on its joint's axis and turns with it."""

    origin_m: Vector3
    """Position of the joint in the frame of the link before or, for the first link, in the body frame."""
    origin_rpy_deg: Vector3 = (0.0, 0.0, 0.0)
    """Attitude of the link's frame at joint angle 0, in the same frame: roll, pitch, yaw (ZYX)."""
    axis: Axis
    """Direction of the joint's axis in the link's frame, of any length; positive angles turn by the right-hand rule."""
    mass_kg: Positive
    com_m: Vector3
    """Centre of mass in the link's frame."""
    inertia_kg_m2: tuple[Positive, Positive, Positive, float, float, float]
    """Elements xx, yy, zz, xy, xz, yz of the inertia about the centre of mass, in the axes of the link's frame."""

    @model_validator(mode="after")
    def _rigid(self) -> Self:
        xx, yy, zz, xy, xz, yz = self.inertia_kg_m2
        if not is_physical_inertia(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))):
            text = "expected the inertia of a rigid body (no principal moment above the sum of the other two)"
            refuse("link", [(("inertia_kg_m2",), text)])
        return self


class Arm(Model):
    """A serial arm of up to 7 joints; the last link carries sensor and net.

    The links are rods along the x axes of their frames, in line with each other at angle 0 (`shoulder_body_m`, `link_lengths_m`,
    `link_masses_kg`, `link_com_m`), or any bodies (`links`, `tip_m`), or those of a URDF file (`urdf`).
    """

    shoulder_body_m: Vector3 = (0.0, 0.0, 0.0)
    """Position of the first joint."""
    link_lengths_m: PositivePerJoint = ()
    """Length of each link, from its joint to the next one; of the last link, to the centre of the net or, without a tool, to the link's
    end.
    """
    link_masses_kg: PositivePerJoint = ()
    """Mass of each link with the servo of the next joint; of the last link, without sensor and net."""
    link_com_m: PositivePerJoint = ()
    """Distance of each link's centre of mass from its joint."""
    links: Annotated[tuple[Link, ...], Field(max_length=JOINTS_MAX)] = ()
    """Links of an arm of any shape, in place of the four keys above; the mass of sensor and net is that of `tool`."""
    tip_m: Vector3 = (0.0, 0.0, 0.0)
    """Centre of the net or, without a tool, end of the arm, in the frame of the last of `links`."""
    tip_rpy_deg: Vector3 = (0.0, 0.0, 0.0)
    """Attitude of the tip's frame, whose x axis points outwards, in the frame of the last of `links`: roll, pitch, yaw (ZYX)."""
    urdf: str | None = None
    """URDF file, relative to the vehicle file, from which `links`, `tip_m` and `tip_rpy_deg` are read (docs/arm.md)."""
    urdf_base: str | None = None
    """Name of the URDF's link that is the vehicle's body. If it is absent, the link that is no joint's child is used."""
    urdf_tip: str | None = None
    """Name of the URDF's link whose frame is the tip. If it is absent, the only link that ends the chain is used."""
    torque_per_amp_nm_a: Positive | None = None
    """Torque constant of the servos, if all of them are of one model. null: stall torque divided by stall current of each model
    (docs/hardware.md)."""
    joint_armature_kg_m2: NonNegative = 0.008
    """Inertia of a servo's rotor and gears, referred to the joint; used by the laws' gains and models and by the simulated arm."""
    joint_friction_nm: NonNegative = 0.04
    """Dry friction of one joint, for laws with friction feedforward."""
    joints: Annotated[tuple[Joint, ...], Field(max_length=JOINTS_MAX)]
    poses: dict[str, PerJoint] = Field(default={})
    """Joint angles, in degrees, that missions refer to by name. Always defined are `folded` (safety.fold_arm_deg) and, for two joints,
    `unfolded` (100, 60 unless given here).
    """

    @property
    def torque_constants_nm_a(self) -> tuple[float, ...]:
        """Return the torque constant of each joint's servo, N m/A: that of the joint, of the arm, or of the servo's model."""
        return tuple(
            joint.torque_per_amp_nm_a or self.torque_per_amp_nm_a or joint.kind.torque_per_amp_nm_a
            for joint in self.joints
        )

    @property
    def armatures_kg_m2(self) -> tuple[float, ...]:
        """Return the inertia of each joint's rotor and gears, referred to the joint."""
        usual = self.joint_armature_kg_m2
        return tuple(usual if joint.armature_kg_m2 is None else joint.armature_kg_m2 for joint in self.joints)

    @model_validator(mode="after")
    def _one_value_per_joint(self) -> Self:
        problems: list[tuple[Location, str]] = []
        count = len(self.joints)
        rods = ("link_lengths_m", "link_masses_kg", "link_com_m")
        if self.links:
            source, parts = ("links", "links") if self.urdf is None else ("urdf", "moving joints")
            if len(self.links) != count:
                text = f"expected {count} {parts}, one for each of arm.joints, got {len(self.links)}"
                problems.append(((source,), text))
            problems += [
                ((key,), f"must be absent, because arm.{source} is given") for key in rods if getattr(self, key)
            ]
            given = [index for index, joint in enumerate(self.joints) if joint.axis is not None]
            problems += [(("joints", index, "axis"), f"must be absent; arm.{source} has the axes") for index in given]
        # Without links, the loader could not read the URDF and reports that.
        others = bool(self.links) or self.urdf is not None
        lists: dict[Location, Joints] = {} if others else {(key,): getattr(self, key) for key in rods}
        lists |= {("poses", name): angles_deg for name, angles_deg in self.poses.items()}
        for location, values in lists.items():
            if len(values) != count:
                problems.append((location, f"expected {count} values, one for each of arm.joints, got {len(values)}"))
        if FOLDED in self.poses:
            problems.append((("poses", FOLDED), "is defined by safety.fold_arm_deg; give this pose another name"))
        for index, joint in enumerate(self.joints):
            for earlier in range(index):
                if self.joints[earlier].servo_id == joint.servo_id:
                    text = f"joint {earlier + 1} has the servo id {joint.servo_id} too; give each servo its own id"
                    problems.append((("joints", index, "servo_id"), text))
                    break
        names = list(
            dict.fromkeys(joint.servo or "other motors" for joint in self.joints if joint.torque_per_amp_nm_a is None)
        )
        if self.torque_per_amp_nm_a is not None and any(joint.servo is None for joint in self.joints):
            problems.append((("torque_per_amp_nm_a",), "must be absent, because arm.joints[].servo is null"))
        if self.torque_per_amp_nm_a is not None and len(names) > 1:
            text = f"one torque constant cannot hold for {' and '.join(names)}; set arm.joints[].torque_per_amp_nm_a instead"
            problems.append((("torque_per_amp_nm_a",), text))
        refuse("arm", problems)
        return self

    @property
    def mass_kg(self) -> float:
        """Mass of all links, without sensor and net."""
        return sum(link.mass_kg for link in self.links) if self.links else sum(self.link_masses_kg)

    @property
    def first_joint_body_m(self) -> Vector3:
        """Position of the first joint in the body frame."""
        return self.links[0].origin_m if self.links else self.shoulder_body_m

    @property
    def reach_m(self) -> float:
        """Largest possible distance of the tip from the first joint."""
        if not self.links:
            return sum(self.link_lengths_m)
        return sum(math.hypot(*link.origin_m) for link in self.links[1:]) + math.hypot(*self.tip_m)


NO_ARM: dict[str, JsonValue] = {
    "shoulder_body_m": [0.0, 0.0, 0.0],
    "link_lengths_m": [],
    "link_masses_kg": [],
    "link_com_m": [],
    "joints": [],
}
"""What `arm: null` in a file stands for; the loader replaces it."""


LINK_RADIUS_M = 0.03
"""Half the thickness of servos and links."""


TOOL_KEYS = {
    "net": ("net_mass_kg", "net_radius_m"),
    "rod": ("mass_kg", "length_m", "tip_radius_m"),
    "brush": ("mass_kg", "length_m", "tip_radius_m", "stiffness_n_m"),
    "clamp": ("mass_kg", "length_m", "tip_radius_m", "jaws"),
}
"""Keys of each kind of tool, in addition to those of the sensor. A rod may have `stiffness_n_m` as well."""


class Jaws(Model):
    """The servo that opens and closes a clamp, on the bus of the arm's servos. It holds its angle by itself (operating mode 5,
    current-based position control), so that the clamp stays as it is when the companion falls silent.
    """

    servo: ServoName = "XL330-M288"
    """Model of the servo."""
    servo_id: Annotated[int, Field(ge=0, le=252)]
    open_deg: Annotated[float, Field(ge=-360, le=360)]
    """Angle of the shaft (register 132) with open jaws."""
    closed_deg: Annotated[float, Field(ge=-360, le=360)]
    """Angle of the shaft with the jaws closed around the handle; empty jaws close further."""
    current_a: Annotated[float, Field(gt=0, le=5)] = 0.4
    """Largest current (register 102), with which the jaws press."""

    @property
    def empty_deg(self) -> float:
        """Angle to which closing jaws are sent: beyond `closed_deg`, where a handle stops them."""
        return self.closed_deg + math.copysign(JAWS_BEYOND_DEG, self.closed_deg - self.open_deg)

    @model_validator(mode="after")
    def _opens(self) -> Self:
        if abs(self.open_deg - self.closed_deg) < 4.0 * JAWS_TOLERANCE_DEG:
            least_deg = 4.0 * JAWS_TOLERANCE_DEG
            text = f"expected at least {least_deg:g} deg from closed_deg ({self.closed_deg:g} deg), got {self.open_deg:g} deg"
            refuse("jaws", [(("open_deg",), text)])
        if abs(self.open_deg - self.empty_deg) >= 360.0:
            most_deg = 360.0 - JAWS_BEYOND_DEG
            text = f"expected less than {most_deg:g} deg from closed_deg ({self.closed_deg:g} deg), got {self.open_deg:g} deg"
            refuse("jaws", [(("open_deg",), f"{text}: the servo loses its turns when it is switched off")])
        return self


JAWS_BEYOND_DEG = 20.0
"""Angle by which empty jaws close further than jaws around a handle."""
JAWS_TOLERANCE_DEG = 5.0
"""The jaws are open or closed if their servo is this near to the angle."""


class Tool(Model):
    """Force-torque sensor and, beyond it, the net, rod, brush or clamp with which the arm works."""

    kind: Literal["net", "rod", "brush", "clamp"] = "net"
    """net: catches a payload; sensor and net are at the tip of the arm. rod: a rod with a ball at its end, in line with the last link.
    brush: a rod with a brush at its end. clamp: a rod with jaws at its end, which close around the spherical handle of a bar: a ball
    joint."""
    sensor_mass_kg: NonNegative
    """Mass of the sensor and the mount on the arm's side, which the sensor does not measure."""
    net_mass_kg: NonNegative | None = None
    """Mass of all parts on the tool side of the sensor; their weight is subtracted from the readings. Nets only."""
    net_radius_m: Positive | None = None
    """Nets only."""
    mass_kg: NonNegative | None = None
    """Mass of all parts beyond the sensor; its weight is subtracted from the readings. Rods, brushes and clamps only."""
    length_m: Positive | None = None
    """Distance of the centre of the ball, brush or jaws from the sensor, which is at the end of the last link, along the x axis of the
    tip's frame. It is the tip of the arm that missions, checks and control laws mean. Rods, brushes and clamps only."""
    tip_radius_m: Positive | None = None
    """Radius of the ball, brush or jaws. Rods, brushes and clamps only."""
    jaws: Jaws | None = None
    """The clamp's servo. Clamps only."""
    stiffness_n_m: Positive | None = None
    """Stiffness of the bristles, or of a rod's ball; a rod without it has a hard ball, which hits a hard surface harder."""
    sensor_rpy_deg: Vector3 = (0.0, 0.0, 0.0)
    """Attitude of the sensor frame in the tip's frame (x outwards; for rods, the frame of the last link): roll, pitch, yaw (ZYX)."""

    @model_validator(mode="after")
    def _keys_of_kind(self) -> Self:
        own, problems = TOOL_KEYS[self.kind], list[tuple[Location, str]]()
        for key in dict.fromkeys(key for keys in TOOL_KEYS.values() for key in keys):
            if (self.kind, key) != ("rod", "stiffness_n_m") and (getattr(self, key) is None) == (key in own):
                text = (
                    f"missing; a {self.kind} has it"
                    if key in own
                    else f"must be absent; a {self.kind} does not have it"
                )
                problems.append(((key,), text))
        refuse("tool", problems)
        return self

    @property
    def is_net(self) -> bool:
        """Whether a payload can be caught."""
        return self.kind == "net"

    @property
    def mass_key(self) -> str:
        """Key of `beyond_sensor_kg`."""
        return TOOL_KEYS[self.kind][0]

    @property
    def beyond_sensor_kg(self) -> float:
        """Mass of everything on the tool side of the sensor."""
        return (self.net_mass_kg if self.is_net else self.mass_kg) or 0.0

    @property
    def beyond_sensor_m(self) -> float:
        """Distance of the tool's centre or tip from the sensor; 0 for a net."""
        return self.length_m or 0.0

    @property
    def radius_m(self) -> float:
        """Radius of the net, ball, brush or jaws."""
        return (self.net_radius_m if self.is_net else self.tip_radius_m) or 0.0
