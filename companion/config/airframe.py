"""Section `airframe` of the vehicle file: masses, rotors and thrust of the flying base."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from companion.config.base import Location, Model, NonNegative, Positive, Positive3, Vector3, refuse
from companion.model.rotors import (
    CCW,
    CW,
    ROTORS_MAX,
    ROTORS_MIN,
    LayoutName,
    RotorLayout,
    SingularLayoutError,
    allocation,
    disk_radius_m,
    listed_layout,
    standard_layout,
)


class Rotor(Model):
    """One rotor, whose thrust points along the body's z axis."""

    position_body_m: Vector3
    spin: Literal["cw", "ccw"]
    """Spin direction seen from above: cw (clockwise) or ccw (counter-clockwise)."""


_SHARE_MIN = 0.2
"""Smallest thrust of a rotor in hover as a fraction of the mean thrust."""


class Airframe(Model):
    """The flying base."""

    mass_kg: Positive
    """Mass of the whole vehicle ready to fly, with the arm and the net, without a payload."""
    inertia_kg_m2: Positive3 = (0.045, 0.045, 0.075)
    """Moments of inertia of the base, without arm and tool, about the body's x, y and z axes; used by the model-based laws and the
    simulated airframe. The default is that of the Tarot 650."""
    layout: LayoutName = "quad_x"
    """Layout of the rotors. Numbers and spin directions of the rotors are those of PX4's airframe of this layout."""
    rotors: tuple[Rotor, ...] | None = None
    """The rotors in PX4's order, if `layout` does not describe them; replaces `layout`, `rotor_arm_m` and `rotor_height_m`."""
    rotor_arm_m: Positive = 0.325
    """Distance of each rotor from the body's z axis; used by the simulated airframe and its CA_ROTOR parameters in PX4. The default
    is that of the Tarot 650."""
    rotor_height_m: float = 0.03
    """Height of the rotors above the body origin."""
    yaw_torque_per_thrust_m: Positive = 0.025
    """Yaw torque of one rotor divided by its thrust, N m/N; used by the simulated airframe and its CA_ROTOR parameters in PX4. The
    default is that of the Tarot 650."""
    thrust_max_n: Positive
    """Thrust of all rotors at full command with a charged battery."""
    battery_cells: Annotated[int, Field(ge=1, le=10)] = 4
    """Number of lithium-polymer cells of the flight battery in series; used by the simulated battery and by its parameters in PX4."""
    hover_thrust: Annotated[float, Field(gt=0, le=1)] | None = None
    """Normalised thrust that carries `mass_kg` in hover. If it is absent, PX4's MPC_THR_HOVER is used."""
    hover_thrust_adapt: bool = True
    """Whether the hover thrust is estimated in flight from the thrust sent, the IMU and the force sensor. If false, it stays
    constant.
    """
    tilt_max_deg: Annotated[float, Field(gt=0, le=45)] = 20.0
    """Largest tilt of an attitude setpoint."""
    ground_clearance_m: Positive
    """Height of the body origin above the floor when the vehicle rests on its landing gear."""
    rotor_radius_m: Positive | None = None
    """Radius of a rotor: half the diameter of the propeller (13 inches: 0.165). The arm must keep clear of the rotors. If it is absent,
    the distance from the outermost rotor to `radius_m` is used."""
    radius_m: Positive = 0.49
    """Horizontal radius around the body origin, including the rotor disks. The default is that of the Tarot 650 with
    13-inch propellers."""
    payload_max_kg: NonNegative = 0.4
    """Payload that is assumed when a mission without `catch:` is checked."""

    @property
    def rotor_layout(self) -> RotorLayout:
        """Positions and spin directions of the rotors."""
        if self.rotors is None:
            return standard_layout(self.layout, self.rotor_arm_m, self.rotor_height_m)
        spins = [CCW if rotor.spin == "ccw" else CW for rotor in self.rotors]
        return listed_layout([rotor.position_body_m for rotor in self.rotors], spins)

    @property
    def disk_radius_m(self) -> float:
        """Radius of a rotor."""
        return self.rotor_radius_m or disk_radius_m(self.rotor_layout, self.radius_m)

    @model_validator(mode="after")
    def _rotors_fly(self) -> Self:
        count = ROTORS_MIN if self.rotors is None else len(self.rotors)
        if not ROTORS_MIN <= count <= ROTORS_MAX:
            text = f"expected {ROTORS_MIN} to {ROTORS_MAX} rotors (PX4 has no more), got {count}"
            refuse("airframe", [(("rotors",), text)])
        rotors = self.rotor_layout
        reach_m = [math.hypot(x, y) for x, y, _ in rotors.positions_body_m]
        far = max(range(rotors.count), key=reach_m.__getitem__)
        if reach_m[far] >= self.radius_m:
            key: Location = ("rotor_arm_m",) if self.rotors is None else ("rotors", far, "position_body_m")
            text = f"expected less than radius_m, {self.radius_m:g} m, from the body's z axis, got {reach_m[far]:g} m"
            refuse("airframe", [(key, text)])
        blades_m = reach_m[far] + (self.rotor_radius_m or 0.0)
        if blades_m > self.radius_m + 1e-9:
            text = (
                f"expected at least {blades_m:g} m, the distance of a rotor from the body's z axis plus rotor_radius_m"
            )
            text += f", got {self.radius_m:g} m"
            refuse("airframe", [(("radius_m",), text)])
        try:
            shares = [row[3] for row in allocation(rotors)]
        except SingularLayoutError as error:
            refuse("airframe", [(("rotors",), f"these rotors cannot be flown: {error}")])
        weakest = min(range(rotors.count), key=shares.__getitem__)
        if shares[weakest] < _SHARE_MIN:
            text = f"the rotors are not balanced about the body origin: in hover, this one has {shares[weakest]:.0%} of the mean thrust"
            refuse("airframe", [(("rotors", weakest), f"{text} (expected at least {_SHARE_MIN:.0%})")])
        return self
