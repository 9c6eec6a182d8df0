"""The vehicle file: the vehicle, its devices, its tether and its room."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Literal, Self

from pydantic import model_validator

from companion.config.airframe import Airframe
from companion.config.arm import FOLDED, LINK_RADIUS_M, UNFOLDED, Arm, Jaws, Tool
from companion.config.base import Location, Model, OrElse, refuse
from companion.config.computer import Computer
from companion.config.device_plugins import DYNAMIXEL
from companion.config.devices import ArmDevice, Devices
from companion.config.ground import Ground
from companion.config.safety import Safety
from companion.config.tether import Room, Tether
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import Joints

OBSERVER = "observer"
"""Value of `force_source`."""
_CELL_MIN_V = (2.8, 4.1)
"""Range of the lowest permitted voltage of a lithium-polymer cell."""


class Vehicle(Model):
    """One vehicle with its devices, tether and room."""

    schema_version: Literal[1]
    name: str
    airframe: Airframe
    arm: Annotated[Arm, OrElse({"type": "null"})]
    """Arm; null states that there is none, and `arm.joints` is then empty (docs/hardware.md)."""
    tool: Tool | None
    """Net, rod or brush, with the force-torque sensor between the last link and it; null states that there is none. Only a net can
    catch (docs/hardware.md)."""
    tether: Tether | None
    """Safety tether; null states that there is none: only the room then limits the flight, and no tether rule is evaluated
    (docs/hardware.md)."""
    room: Room
    devices: Devices
    force_source: Literal["sensor", "observer"] = "sensor"
    """Source of the force that the control law uses and from which a catch is detected: `devices.force` (no force if that is null), or
    a momentum observer, which estimates the force from thrust and motion (docs/hardware.md). With the observer, a force sensor is only
    logged, to show the observer's error."""
    computer: Computer = Computer()
    safety: Safety = Safety()
    ground: Ground = Ground()

    @property
    def fold_arm_deg(self) -> Joints:
        """Joint angles of the folded arm, deg."""
        return self.safety.fold_arm_deg[: len(self.arm.joints)]

    @property
    def joint_torque_limits_nm(self) -> Joints:
        """Largest torque that is commanded to each joint, N m: `torque_max_nm`, or what the largest current of its servo gives."""
        return tuple(
            min(joint.torque_max_nm, (self.safety.servo_current_max_a or joint.kind.stall_current_a) * nm_a)
            for joint, nm_a in zip(self.arm.joints, self.arm.torque_constants_nm_a, strict=True)
        )

    @property
    def arm_device(self) -> ArmDevice:
        """Bus of the arm's servos; may be read only if there is an arm."""
        assert self.devices.arm is not None, "the vehicle has no arm"
        return self.devices.arm

    @property
    def poses_deg(self) -> dict[str, Joints]:
        """Joint angles of each named pose, deg."""
        usual = {UNFOLDED: (100.0, 60.0)} if len(self.arm.joints) == 2 else {}
        return {FOLDED: self.fold_arm_deg, **usual, **self.arm.poses}

    @property
    def tip_radius_m(self) -> float:
        """Radius around the tip, m: that of the net, ball, brush or jaws or, without a tool, half the thickness of the link."""
        return self.tool.radius_m if self.tool is not None else LINK_RADIUS_M

    @property
    def tip_name(self) -> str:
        """Name of the tip in messages."""
        if self.tool is None:
            return "end of the arm"
        return "net" if self.tool.is_net else f"{self.tool.kind}'s tip"

    @property
    def tool_mass_kg(self) -> float:
        """Mass of the sensor and of what is beyond it, kg; 0 without a tool."""
        return self.tool.sensor_mass_kg + self.tool.beyond_sensor_kg if self.tool is not None else 0.0

    @property
    def reach_m(self) -> float:
        """Largest possible distance of the tip, of which a rod is part, from the first joint, m."""
        return self.arm.reach_m + (self.tool.beyond_sensor_m if self.tool is not None else 0.0)

    @property
    def has_net(self) -> bool:
        """Whether a payload can be caught."""
        return self.tool is not None and self.tool.is_net

    @property
    def jaws(self) -> Jaws | None:
        """The servo of the clamp; None without a clamp."""
        return self.tool.jaws if self.tool is not None else None

    @model_validator(mode="after")
    def _parts_fit(self) -> Self:
        problems: list[tuple[Location, str]] = []
        for index, (com_m, length_m) in enumerate(zip(self.arm.link_com_m, self.arm.link_lengths_m, strict=True)):
            if com_m > length_m:
                text = f"the centre of mass is beyond the end of the link: at {com_m:g} m on a link of {length_m:g} m"
                problems.append((("arm", "link_com_m", index), text))
        problems += self._poses_within_limits()
        kinds = [joint.kind for joint in self.arm.joints if joint.servo is not None]
        coolest = min(kinds, key=lambda kind: kind.temperature_max_c, default=None)
        if coolest is not None and self.safety.servo_max_c >= coolest.temperature_max_c:
            text = (
                f"expected less than {coolest.temperature_max_c:g} degC, at which the {coolest.name} switches its torque off, got "
                f"{self.safety.servo_max_c:g} degC{self._default_note('servo_max_c')}"
            )
            problems.append((("safety", "servo_max_c"), text))
        fastest_deg_s = max((joint.velocity_max_deg_s for joint in self.arm.joints), default=0.0)
        if fastest_deg_s >= self.safety.joint_rate_max_deg_s:
            text = (
                f"expected more than {fastest_deg_s:g} deg/s, the largest planned speed of a joint (arm.joints[].velocity_max_deg_s), "
                f"because the vehicle lands above this rate, got {self.safety.joint_rate_max_deg_s:g} deg/s"
            )
            problems.append((("safety", "joint_rate_max_deg_s"), text))
        for axis, own in enumerate(self.airframe.inertia_kg_m2):
            others = sum(self.airframe.inertia_kg_m2) - own
            if own > others * (1.0 + 1e-9):
                text = f"expected at most {others:g} kg m^2 (no moment of a rigid body exceeds the sum of the other two), got {own:g}"
                problems.append((("airframe", "inertia_kg_m2", axis), text))
        if self.tool is None and self.devices.force is not None:
            text = "the force-torque sensor is part of the tool, but tool is absent; add tool, or set devices.force to null"
            problems.append((("devices", "force"), text))
        if self.tool is not None and not self.arm.joints:
            text = "the tool is mounted on the arm's last link, but arm is null; set tool to null"
            problems.append((("tool",), text))
        if (self.devices.arm is None) != (not self.arm.joints):
            text = (
                "missing; the arm's servos need a bus"
                if self.devices.arm is None
                else "must be null, because arm is null"
            )
            problems.append((("devices", "arm"), text))
        problems += self._motors_fit()
        carried_kg = self.arm.mass_kg + self.tool_mass_kg
        if carried_kg >= self.airframe.mass_kg:
            text = f"{self.airframe.mass_kg:g} kg is the mass of the whole vehicle, but arm and tool alone have {carried_kg:g} kg"
            problems.append((("airframe", "mass_kg"), text))
        if self.airframe.thrust_max_n <= GRAVITY_M_S2 * self.airframe.mass_kg:
            text = f"{self.airframe.thrust_max_n:g} N do not lift {self.airframe.mass_kg:g} kg"
            problems.append((("airframe", "thrust_max_n"), text))
        nearest_m = min(math.hypot(x, y) for x, y, _ in self.airframe.rotor_layout.positions_body_m)
        if self.tether is not None and nearest_m <= self.tether.rotor_inner_radius_m:
            text = f"expected less than {nearest_m:g} m, the distance of the nearest rotor from the body's z axis"
            text += f", got {self.tether.rotor_inner_radius_m:g} m"
            problems.append((("tether", "rotor_inner_radius_m"), text))
        cells, lowest_v = self.airframe.battery_cells, self.safety.battery_voltage_min_v
        low_v, high_v = (cells * cell_v for cell_v in _CELL_MIN_V)
        if lowest_v is not None and not low_v <= lowest_v <= high_v:
            text = (
                f"expected {low_v:.1f} to {high_v:.1f} V for the {cells} cells of airframe.battery_cells, got {lowest_v:g} V"
                + self._default_note("battery_voltage_min_v")
            )
            problems.append((("safety", "battery_voltage_min_v"), text))
        refuse("vehicle", problems)
        return self

    def _motors_fit(self) -> Iterator[tuple[Location, str]]:
        """Yield the keys of servos that a vehicle has although a plug-in drives its arm."""
        device, joints = self.devices.arm, self.arm.joints
        if device is not None and device.type != DYNAMIXEL:
            text = f"must be null, because devices.arm.type is {device.type}"
            yield from (
                (("arm", "joints", index, "servo"), text) for index, one in enumerate(joints) if one.servo is not None
            )
        if self.jaws is not None and device is not None:
            if device.type != DYNAMIXEL:
                yield ("tool", "jaws"), f"a clamp needs devices.arm.type {DYNAMIXEL}, got {device.type}"
            for number, joint in enumerate(joints, 1):
                if joint.servo_id == self.jaws.servo_id:
                    text = f"joint {number} has the servo id {joint.servo_id} too; give each servo its own id"
                    yield ("tool", "jaws", "servo_id"), text
        if self.safety.servo_current_max_a is not None and any(joint.servo is None for joint in joints):
            yield ("safety", "servo_current_max_a"), "must be null, because arm.joints[].servo is null"

    def _default_note(self, key: str) -> str:
        """Return a note for a message if the key of `safety` is not in the file, so that its default is used."""
        return "" if key in self.safety.model_fields_set else " (the default, because the file does not give it)"

    def _poses_within_limits(self) -> Iterator[tuple[Location, str]]:
        joints, fold = self.arm.joints, self.safety.fold_arm_deg
        if joints and len(fold) != len(joints):
            angles = "1 angle" if len(joints) == 1 else f"{len(joints)} angles"
            text = f"expected {angles}, one for each of arm.joints, got {len(fold)}{self._default_note('fold_arm_deg')}"
            yield ("safety", "fold_arm_deg"), text
            return
        poses: list[tuple[Location, Joints]] = [(("safety", "fold_arm_deg"), self.fold_arm_deg)]
        poses += [(("arm", "poses", name), at) for name, at in self.arm.poses.items()]
        for location, angles_deg in poses:
            for index, (joint, angle_deg) in enumerate(zip(joints, angles_deg, strict=True)):
                low_deg, high_deg = joint.angle_deg
                if not low_deg <= angle_deg <= high_deg:
                    text = f"{angle_deg:g} deg is outside the joint limits, {low_deg:g} to {high_deg:g} deg"
                    yield (*location, index), text
