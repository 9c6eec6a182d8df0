"""When a vehicle that lands lets its end of the bar go, and what it tells the other vehicle. Pure."""

from __future__ import annotations

import math
from typing import Final

from companion.core.flight_state import FlightState
from companion.core.reactions import land_now
from companion.core.transition import Transition
from companion.model.best_pose import best_pose
from companion.model.flight_stage import Stage
from companion.model.frames import quat_rotate
from companion.model.team import ClampCommand, Grip, PartnerState, TeamState
from companion.model.types import Inputs, SafetyAction, Vec3
from companion.safety import notices

CONFIRMED_SHARE: Final = 0.5
"""Share of the limit that the vehicle's motion must show: its estimate of a sudden pull is 0.1 s late."""
_HERE: Final = frozenset({Stage.MISSION, Stage.TOUCHDOWN, Stage.AUTOPILOT_LAND, Stage.DISARM, Stage.STAND_DOWN})
_NOWHERE: Vec3 = (0.0, 0.0, 0.0)


def let_go_if_better(t: Transition) -> None:
    """Open the clamp that holds the bar if that is better than to keep it. A mission that loses its bar this way ends: its phase would
    close the clamp again.
    """
    why = _why(t)
    if why is not None:
        t.report(notices.BAR_LET_GO, f"the bar is let go: {why}")
        t.change(clamp=ClampCommand.OPEN, grip=Grip.FREE, bar=None)
        if t.state.stage is Stage.MISSION and not t.state.aborting:
            land_now(t)


def _why(t: Transition) -> str | None:
    """Return why the bar is to be let go; None to keep it."""
    state, i = t.state, t.i
    bar, force = state.bar, t.o.force_world_n
    assert bar is not None
    limit_n = t.parameters.vehicle.safety.bar_let_go_n
    pulls = force is not None and state.grip is Grip.CARRYING and math.hypot(*force) > limit_n
    if force is not None and pulls and _moves_so(t.o.disturbance_world_n, limit_n):
        return f"it pulls with {math.hypot(*force):.0f} N (limit {limit_n:.0f} N)"
    if state.supervisor.action is SafetyAction.TERMINATE:
        return "this vehicle falls"
    by_px4 = state.stage is Stage.AUTOPILOT_LAND
    if not (state.aborting or by_px4 or state.stage not in _HERE):
        return None
    if not by_px4 and i.t_s >= state.opens_s:  # the time is that of the companion's own descent
        return "it stands on the floor"
    if by_px4 or state.stage not in _HERE or _lands_otherwise(t, i.partner):
        height_m = _clamp_height_m(t)
        if height_m is not None and height_m <= bar.let_go_m:
            return f"its feet are {max(0.0, height_m - bar.stands_m):.2f} m above the floor"
    return None


def _moves_so(disturbance_world_n: Vec3 | None, limit_n: float) -> bool:
    """Return whether the vehicle's motion confirms the pull, or is unknown: a wrong force sensor alone does not drop the bar."""
    return disturbance_world_n is None or math.hypot(*disturbance_world_n) > CONFIRMED_SHARE * limit_n


def _lands_otherwise(t: Transition, partner: PartnerState | None) -> bool:
    """Return whether the other vehicle does not land together with this one: it is silent, has let go, or PX4 lands it."""
    if partner is None or t.i.t_s - partner.stamp_s > t.parameters.vehicle.safety.partner_timeout_s:
        return True
    return partner.said.px4_lands or partner.said.grip is Grip.FREE


def _clamp_height_m(t: Transition) -> float | None:
    """Return the height of the clamp's centre above the floor; None if it is unknown."""
    pose, arm = best_pose(t.i), t.i.arm
    if pose is None or arm is None:
        return None
    return (
        pose.position_world_m[2]
        + quat_rotate(pose.attitude_wxyz, t.parameters.manipulator.net_body_m(arm.angle_rad))[2]
    )


def team_state_of(state: FlightState, i: Inputs, agreed: str | None) -> TeamState:
    """Return what this vehicle announces to the other; `agreed` is that of `FlightConfig`."""
    action, vehicle = state.supervisor.action, i.vehicle
    return TeamState(
        grip=state.grip,
        together=state.expected.together,
        holds=action.rank >= SafetyAction.HOLD.rank,
        lands=state.aborting and action.rank >= SafetyAction.LAND.rank,
        px4_lands=state.stage is Stage.AUTOPILOT_LAND,
        position_world_m=_NOWHERE if vehicle is None else vehicle.position_world_m,
        server_s=None if i.mocap is None else i.mocap.exposure_server_s,
        system_id=None if i.status is None else i.status.system_id,
        agreed=agreed,
    )
