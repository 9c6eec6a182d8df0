"""The stages of a flight before its take-off is begun: what the vehicle still lacks, and why a flight is refused. Pure."""

from __future__ import annotations

from typing import Final

from companion.config.vehicle import Vehicle
from companion.core.flight_state import Tare
from companion.core.transition import Transition
from companion.mission.check import check_start
from companion.mission.plan import Plan
from companion.mission.settled import SettledEstimate
from companion.model import flight_stage as seq
from companion.model.flight_stage import Stage
from companion.model.frames import euler_zyx_from_quat
from companion.model.types import AutopilotRequest, Inputs, Joints, Outcome
from companion.safety import notices
from companion.safety.mocap import unfused
from companion.safety.notices import EventDefinition
from companion.safety.team import strangers


def wait(t: Transition, elapsed_s: float) -> AutopilotRequest:
    """Wait until the vehicle is ready, and answer a command to start meanwhile."""
    _wait_for_readiness(t, elapsed_s)
    if t.start_asked:
        _decline_start(t)
    return AutopilotRequest.NONE


def _wait_for_readiness(t: Transition, elapsed_s: float) -> None:
    """Wait until every input of the vehicle has arrived and PX4 has followed motion capture for the duration of the tare."""
    i, was_ready = t.i, t.state.waiting.was_ready
    overdue = elapsed_s > seq.WAIT_TIMEOUT_S and not was_ready
    missing = missing_inputs(i, t.parameters.vehicle)
    problem = _nothing_from(missing) if missing else unfused(i)
    if problem is not None:
        t.change_waiting(unready=problem, tare_start_s=None, settled=SettledEstimate())
        if overdue:
            refuse(t, notices.INPUTS_MISSING if missing else notices.VISION_NOT_FUSED, problem)
        return
    if t.state.waiting.tare_start_s is None:
        _begin_tare(t)
    _weigh(t)
    tare_start_s = t.state.waiting.tare_start_s
    assert tare_start_s is not None
    settled, tared = t.state.waiting.settled, i.t_s - tare_start_s >= seq.TARE_S
    wanders = settled.problem(i.t_s)
    if not tared and (wanders is None or not settled.lasted(i.t_s)):
        t.change_waiting(unready="the vehicle has not stood still for long enough; meanwhile a force sensor is tared")
        return
    if wanders is not None:
        t.change_waiting(unready=wanders)
        if tared:  # while something moved
            _begin_tare(t)
        if overdue:
            refuse(t, notices.ESTIMATE_UNSTEADY, wanders)
        return
    t.tare.append(Tare.FINISH)
    problems = _start_problems(t)
    if not problems:
        _is_ready(t)
    elif was_ready:  # the vehicle was moved, and may be put back
        t.change_waiting(unready=problems[0])
    else:
        refuse_start(t, problems)


def _is_ready(t: Transition) -> None:
    if not t.parameters.waits_for_start:
        _take_off(t)
        return
    t.change_waiting(
        was_ready=True, unready="the vehicle has only just become ready; send the command again", looked_s=t.i.t_s
    )
    _begin_tare(t)
    t.enter(Stage.READY)


def ready(t: Transition, _: float) -> AutopilotRequest:
    """Wait until the operator starts the take-off or a required input is lost."""
    i, waiting = t.i, t.state.waiting
    missing = missing_inputs(i, t.parameters.vehicle)
    problem = _nothing_from(missing) if missing else unfused(i)
    if problem is None:
        assert waiting.tare_start_s is not None
        _weigh(t)
        if i.t_s - waiting.tare_start_s >= seq.TARE_S:
            t.tare.append(Tare.FINISH)
            _begin_tare(t)
        if t.start_asked or i.t_s - waiting.looked_s >= seq.LOOK_AGAIN_S:
            t.change_waiting(looked_s=i.t_s)
            problem = t.state.waiting.settled.problem(i.t_s) or next(iter(_start_problems(t)), None)
    else:
        t.change_waiting(settled=SettledEstimate())
    if problem is not None:
        t.change_waiting(unready=problem, tare_start_s=None)
        t.report(notices.NOT_READY, f"no longer ready: {problem}")
        t.enter(Stage.WAIT)
        if t.start_asked:
            _decline_start(t)
    elif t.start_asked:
        _take_off(t)
    return AutopilotRequest.NONE


def _begin_tare(t: Transition) -> None:
    t.tare.append(Tare.BEGIN)
    t.change_waiting(tare_start_s=t.i.t_s)


def _weigh(t: Transition) -> None:
    i = t.i
    assert i.vehicle is not None
    t.tare.append(Tare.COLLECT)
    t.change_waiting(settled=t.state.waiting.settled.take(i.t_s, i.vehicle, i.mocap))


def _start_problems(t: Transition) -> list[str]:
    """Return how the vehicle's pose differs from the mission's start, and why the other vehicle of its team cannot fly with it; an
    empty list if there is nothing, or nothing is known.
    """
    return misplaced(t) + strangers(t.i, t.parameters.config.agreed)


def misplaced(t: Transition) -> list[str]:
    """Return how the vehicle's pose differs from the mission's start; empty if it does not, or if the pose is not known."""
    vehicle, p = t.i.vehicle, t.parameters
    if vehicle is None or (p.vehicle.arm.joints and t.i.arm is None):
        return []
    yaw_rad = euler_zyx_from_quat(vehicle.attitude_wxyz)[2]
    return check_start(p.config.mission, p.vehicle, vehicle.position_world_m, yaw_rad, _arm_rad(t))


def _take_off(t: Transition) -> None:
    """Plan the mission from the present position and enter OFFBOARD."""
    vehicle, p = t.i.vehicle, t.parameters
    assert vehicle is not None
    yaw_rad = euler_zyx_from_quat(vehicle.attitude_wxyz)[2]
    t.change(plan=Plan.build(p.config.mission, p.vehicle, vehicle.position_world_m, yaw_rad, _arm_rad(t)))
    t.enter(Stage.OFFBOARD)


def _arm_rad(t: Transition) -> Joints:
    """Return the measured joint angles, rad; empty if the vehicle has no arm."""
    if not t.parameters.vehicle.arm.joints:
        return ()
    assert t.i.arm is not None
    return t.i.arm.angle_rad


def _decline_start(t: Transition) -> None:
    waits = t.parameters.waits_for_start
    text = t.state.waiting.unready if waits else "this flight takes off by itself as soon as it is ready"
    t.report(notices.START_DECLINED, text)


def refuse_start(t: Transition, problems: list[str]) -> None:
    """Report what keeps the vehicle from the start of the mission, and end the flight."""
    for problem in problems:
        t.report(notices.START_REFUSED, problem)
    t.stand_down(Outcome.REFUSED)


def refuse(t: Transition, notice: EventDefinition, text: str) -> None:
    """Report why there is no take-off, and end the flight."""
    t.report(notice, text)
    t.stand_down(Outcome.REFUSED)


def missing_inputs(i: Inputs, vehicle: Vehicle) -> list[str]:
    """Return the devices of the vehicle that have delivered no data yet."""
    devices: dict[str, object] = {"PX4 state": i.vehicle, "PX4": i.status}
    if vehicle.devices.mocap.external:
        devices["PX4's ESTIMATOR_STATUS"] = i.estimator
    else:
        devices["motion capture"] = i.mocap
    if vehicle.arm.joints:
        devices["arm"] = i.arm
    if vehicle.devices.force is not None:
        devices["force sensor"] = i.force
    if vehicle.jaws is not None:
        devices["clamp"] = i.clamp
    if vehicle.devices.team is not None:
        partner, timeout_s = i.partner, vehicle.safety.partner_timeout_s
        devices["other vehicle"] = None if partner is None or i.t_s - partner.stamp_s > timeout_s else partner
    return [name for name, value in devices.items() if value is None]


def _nothing_from(missing: list[str]) -> str:
    hints = "".join(f"; {hint}" for device, hint in _HINTS.items() if device in missing)
    return f"no data from: {', '.join(missing)}{hints}"


_HINTS: Final = {
    "PX4 state": "PX4 sends no local position: check EKF2_EV_CTRL = 11 and EKF2_HGT_REF = 3",
    "other vehicle": "start the other vehicle, as the other member and with the same key, and check the addresses in devices.team",
}
