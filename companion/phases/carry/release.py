"""Phase `release`."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Final, Literal

from msgspec.structs import replace
from pydantic import Field

from companion.config.phase import ArmPose, Duration, PhaseSettings
from companion.mission.air import Air, Expectation
from companion.mission.bar_landing import BACK_M, RISE_M
from companion.mission.phase import Phase, Planning
from companion.model.codec import Record
from companion.model.frames import quat_from_euler_zyx, quat_rotate
from companion.model.team import ClampCommand, Grip
from companion.model.types import SafetyAction, Severity, Vec3
from companion.phases.carry.bar import turned_about_z
from companion.phases.carry.grip import OVER_BAR_M, is_at
from companion.safety.notices import EventDefinition

RELEASED = EventDefinition("released", Severity.INFO, SafetyAction.NOMINAL, "the clamp has opened and let the bar go")
NOT_RELEASED = EventDefinition(
    "not_released", Severity.CRITICAL, SafetyAction.WARN,
    "the clamp has not opened: the vehicle stays where it is, with the bar standing on the floor, until it opens or the operator lands",
)  # fmt: skip

OPENING_S: Final = 1.0
"""Time at rest in which the clamp opens."""
OPEN_MAX_S: Final = 3.0


class Releasing(Record, frozen=True, kw_only=True):
    """State of the phase."""

    begun_s: float
    begun_m: Vec3
    """Planned position of the vehicle then, world frame."""
    back_m: Vec3
    """Way backwards and up, away from the bar."""
    over_bar: bool = True
    """Whether a landing must first move away from the bar."""
    open: bool = False
    reported: bool = False


class Release(Phase):
    """Let the bar go, rise above it, and fly backwards, away from it."""

    acts: ClassVar[bool] = True

    type: Literal["release"]
    rise_m: Annotated[float, Field(ge=0.05, le=0.5)] = 0.15
    rise_s: Duration = 1.5
    apart_m: Annotated[float, Field(ge=0.3, le=2.0)] = 0.6
    """Distance of the way backwards, at whose end the rotors are clear of the bar."""
    apart_s: Duration = 3.0
    arm_deg: ArmPose
    """Joint angles at the end."""

    def order_problem(self, before: PhaseSettings | None) -> str | None:
        """Return why this phase cannot follow another one."""
        return None if before is not None and before.type == "carry" else "only a bar that is carried can be released"

    def plan(self, p: Planning) -> None:
        """Append the opening at rest, the rise, and the way backwards, on which the arm moves."""
        builder = p.builder
        builder.t_s += OPENING_S
        x, y, z = builder.position_m
        builder.move_vehicle((x, y, z + self.rise_m), self.rise_s)
        builder.t_s += self.rise_s
        dx, dy, _ = quat_rotate(quat_from_euler_zyx(0.0, 0.0, builder.yaw_rad), (-self.apart_m, 0.0, 0.0))
        builder.move_vehicle((x + dx, y + dy, z + self.rise_m), self.apart_s)
        builder.move_arm(tuple(map(math.radians, self.arm_deg)), 0.0, self.apart_s, p.arm_limits)
        builder.t_s += self.apart_s

    def begin(self, air: Air) -> Releasing:
        """Return the state at the start."""
        back_m = turned_about_z((-BACK_M, 0.0, RISE_M), air.plan_reference().yaw_rad)
        return Releasing(begun_s=air.t_s, begun_m=air.plan_reference().position_world_m, back_m=back_m)

    def step(self, air: Air, own: Any) -> Releasing | None:
        """Return the state after one tick; None at the end."""
        s: Releasing = own
        if s.open:
            if air.segment.index != air.engaged.index:
                return None
            return replace(s, over_bar=math.dist(air.plan_reference().position_world_m[:2], s.begun_m[:2]) < OVER_BAR_M)
        if is_at(air.i, air.vehicle.jaws, ClampCommand.OPEN):
            air.report(RELEASED, "the bar is let go")
            return replace(s, open=True)
        waited_s = air.t_s - s.begun_s
        if waited_s >= 0.5 * OPENING_S:
            air.move_to(air.engaged.start_s)
        if waited_s >= OPEN_MAX_S and not s.reported:
            air.report(NOT_RELEASED, f"the clamp has not opened within {OPEN_MAX_S:g} s; waiting")
            s = replace(s, reported=True)
        return s

    def expects(self, own: Any) -> Expectation:
        """Return the clamp's command."""
        s: Releasing = own
        return Expectation(
            clamp=ClampCommand.OPEN,
            grip=Grip.FREE if s.open else Grip.STANDING,
            back_m=s.back_m if s.over_bar else None,
        )
