"""`companion arm scan|setup|zero|jog|friction|reboot`: commissioning of the arm, from new servos to measured parameters."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, Final

from companion.commissioning.arm import scan as arm_scan
from companion.commissioning.arm import setup as arm_setup
from companion.commissioning.arm.bus import BAUDS, ServoTalk
from companion.commissioning.arm.drive import Driven, Leader, drive
from companion.commissioning.arm.friction import Estimate, fit
from companion.commissioning.arm.jog import ByKeys
from companion.commissioning.arm.motion import LOAD_NM, SPEED_MAX_DEG_S, TORQUE_SHARE, limits_deg
from companion.commissioning.arm.servo import ClampJoint, Scan, joint_in, with_clamp
from companion.commissioning.arm.sweep import Leg, Sample, Sweeper, duration_s, legs_of
from companion.commissioning.arm.zero import ZeroGuide, ZeroResult
from companion.commissioning.arm.zero_session import hold
from companion.commissioning.tool import ARM, Cancelled, Report, Session, Tool
from companion.config.document import ConfigError
from companion.config.vehicle import Vehicle
from companion.io.dynamixel.registers import HARDWARE_ERROR
from companion.model.check_row import Level
from companion.model.servos import hardware_error_text
from companion.runtime.terminal import Bars, pressed, raw_keys


def _stand_text(vehicle: Vehicle) -> str:
    arm = vehicle.arm
    below_m = vehicle.reach_m + vehicle.tip_radius_m - arm.first_joint_body_m[2]
    text = f"the arm reaches {below_m:.2f} m below the body"
    if below_m <= vehicle.airframe.ground_clearance_m:
        return text
    clearance = f"on its landing gear the vehicle has {vehicle.airframe.ground_clearance_m:.2f} m of clearance"
    return f"{text}, but {clearance}: put it on a level stand, with nothing below the arm"


def _scan(session: Session) -> Scan:
    baud = session.arguments.baud
    if baud not in (None, *BAUDS):
        raise ConfigError(f"--baud {baud}: expected one of {', '.join(map(str, BAUDS))}")
    return arm_scan.scan_for(session, baud)


def _judge_scan(found: Scan, vehicle: Vehicle) -> Report:
    judged = arm_scan.judge(found, vehicle)
    wrong = {row.id for row in judged.rows if not row.ok and row.level is not Level.WARN}
    settled = {"arm.scan.baud" if "baud" in location else "arm.scan.ids" for location in judged.changes}
    return Report(
        judged.rows,
        arm_scan.as_json(found, judged),
        arm_scan.table(found, judged),
        judged.changes,
        advice=[] if wrong else ["the servos match the vehicle file"],
        ok=wrong <= settled,
        brief={f"arm.scan.joint{n}": f"joint {n}: settings" for n in range(1, len(with_clamp(vehicle).joints) + 1)},
    )


def _zero(session: Session) -> ZeroResult:
    guide = ZeroGuide(session.vehicle.arm)
    session.say("zero: the arm is limp and nothing moves by itself; propellers off", "bold")
    session.say(f"  {_stand_text(session.vehicle)}")
    session.say(
        "  the servos' LEDs are on during a step and go off when it is accepted: when the arm is held still for 2 s, or on Enter"
    )
    for number, step in enumerate(guide.steps, 1):
        session.say(f"  {number}. {step.instruction}")
    return hold(session.vehicle, guide, session.console)


def _judge_zero(result: ZeroResult, vehicle: Vehicle) -> Report:
    text, joints = [], []
    if result.swapped:
        text.append("the servos are swapped: each moved when the other joint was requested")
    for number, (found, joint) in enumerate(zip(result.joints, vehicle.arm.joints, strict=True), 1):
        error_deg = result.error_deg(vehicle.arm, number - 1)
        turned = "" if found.sign == joint.sign else ", the opposite of the vehicle file's"
        spread = "" if found.spread_deg is None else f", poses agree within {found.spread_deg:.1f} deg"
        text.append(
            f"joint {number}: servo {found.servo_id}, sign {found.sign:+d}{turned}, zero_count {found.zero_count} "
            f"(the vehicle file's is {error_deg:+.1f} deg off){spread}"
        )
        joints.append({"joint": number, **asdict(found), "file_error_deg": error_deg})
    changes = result.changes(vehicle.arm)
    if not changes:
        text.append("the vehicle file is correct within the accuracy of a hand-held pose")
    return Report((), {"swapped": result.swapped, "joints": joints}, text, changes)


async def _drive(session: Session, leader: Leader, what: str) -> Driven:
    part = session.arguments.part
    session.say(f"{part}: {what}", "bold")
    session.say(f"  propellers off; {_stand_text(session.vehicle)}")
    bounds = f"at most {SPEED_MAX_DEG_S:g} deg/s and {100 * TORQUE_SHARE:.0f} % of the torque"
    session.say(
        f"  {bounds}; the arm stops at {LOAD_NM:g} N m beyond gravity, at its torque limit, and immediately on Ctrl-C"
    )
    session.say("  at the end the arm always goes limp: keep hands and objects out of the space below it")
    answer = session.ask("may the arm move now?")
    if answer is None:
        raise ConfigError(f"companion arm {part}: there is no terminal to ask whether the arm may move; add --yes")
    if not answer:
        raise Cancelled("the arm was not moved")
    with Bars(session.console, [f"joint {number}" for number in range(1, len(session.vehicle.arm.joints) + 1)]) as bars:
        return await drive(session.vehicle, leader, bars)


async def _jog(session: Session) -> Driven:
    arguments, arm = session.arguments, session.vehicle.arm
    joint, goal_deg = joint_in(arm, arguments.joint), arguments.to
    if (goal_deg is None) != (joint is None):
        raise ConfigError("companion arm jog: --joint N and --to DEG belong together; without both, keys move the arm")
    if goal_deg is not None and joint is not None:
        low, high = limits_deg(arm, joint)
        if not low <= goal_deg <= high:
            expected = f"expected {low:g} to {high:g} deg, joint {joint + 1}'s limits minus a margin"
            raise ConfigError(f"companion arm jog: --to {goal_deg:g}: {expected}")
        leader = Sweeper([Leg(joint, goal_deg, SPEED_MAX_DEG_S)], arm.torque_constants_nm_a)
        return await _drive(session, leader, f"joint {joint + 1} moves to {goal_deg:g} deg")
    if sys.stdin is None or not sys.stdin.isatty():
        raise ConfigError(
            "companion arm jog: no terminal to read keys from; --joint N --to DEG --yes moves without keys"
        )
    joints = f"1 to {len(arm.joints)}" if len(arm.joints) > 2 else "1, 2"
    keys = f"{joints}: select the joint; arrows or + and -: move it while held; any other key: stop; q: end"
    with raw_keys() as descriptor:
        return await _drive(session, ByKeys(lambda: pressed(descriptor)), f"keys move the arm; {keys}")


def _judge_jog(driven: Driven, vehicle: Vehicle) -> Report:
    angles = ", ".join(f"{angle:.1f}" for angle in driven.angle_deg)
    load_nm = max(driven.load_max_nm)
    text = [f"stopped: {driven.stop}"] if driven.stop else []
    text.append(f"the arm is limp, at ({angles}) deg; at most {load_nm:.2f} N m beyond gravity")
    data = {"stopped": driven.stop, "angle_deg": list(driven.angle_deg), "load_max_nm": list(driven.load_max_nm)}
    return Report((), data, text, ok=not driven.stop)


async def _sweep(session: Session) -> tuple[Driven, Sequence[Sample]]:
    vehicle = session.vehicle
    legs = legs_of(vehicle)
    leader = Sweeper(legs, vehicle.arm.torque_constants_nm_a)
    seconds = duration_s(legs, vehicle.safety.fold_arm_deg)
    driven = await _drive(
        session, leader, f"each joint sweeps slowly, about the hanging pose, for about {seconds:.0f} s in all"
    )
    return driven, leader.samples


def _judge_sweep(swept: tuple[Driven, Sequence[Sample]], vehicle: Vehicle) -> Report:
    driven, samples = swept
    if driven.stop:
        data: Mapping[str, Any] = {"stopped": driven.stop, "joints": [None for _ in vehicle.arm.joints], "notes": []}
        return Report((), data, [f"stopped: {driven.stop}"], ok=False)
    found = fit(samples, vehicle)
    text = []
    for number, one in enumerate(found.joints, 1):
        if one is not None:
            text += [
                f"joint {number}, from {one.bins} means over {one.gravity_span_nm:.2f} N m of gravity:",
                f"  torque constant   {one.torque_per_amp_nm_a.text(3)} N m/A",
                f"  dry friction      {one.dry_nm.text(4)} N m",
                f"  viscous friction  {one.viscous_nms.text(4)} N m s/rad",
                f"  turned by         {one.off_deg.text(2)} deg",
            ]
    constants = set(zip(found.torque_constants_nm_a, vehicle.arm.torque_constants_nm_a, strict=True))
    for index, (constant, has_nm_a) in enumerate(
        zip(found.torque_constants_nm_a, vehicle.arm.torque_constants_nm_a, strict=True)
    ):
        if len(constants) > 1 or index == 0:
            name = f"arm.joints[{index}].torque_per_amp_nm_a" if len(constants) > 1 else "torque_per_amp_nm_a"
            text.append(f"{name}: {_value(constant, 'N m/A')}; the vehicle file has {has_nm_a:g}")
    has = vehicle.arm.joint_friction_nm
    text.append(f"joint_friction_nm: {_value(found.joint_friction_nm, 'N m')}; the vehicle file has {has:g}")
    known = None not in found.torque_constants_nm_a and found.joint_friction_nm is not None
    data = {"stopped": "", **asdict(found)}
    return Report((), data, [*text, *found.notes], found.changes(vehicle), ok=known)


def _value(estimate: Estimate | None, unit: str) -> str:
    return "not determined" if estimate is None else f"{estimate.text(3)} {unit}"


def _reboot(session: Session) -> list[tuple[str, int, int]]:
    """Reboot all servos, the clamp's included; return name and hardware error before and afterwards of each."""
    if not session.confirm("the servos' torque goes off and the arm drops; reboot them?"):
        raise Cancelled("no servo was rebooted")
    device, errors = session.vehicle.arm_device, []
    with ServoTalk(device.servo_port) as talk:
        talk.open(device.baud)
        for number, joint in enumerate(with_clamp(session.vehicle).joints, 1):
            before = talk.read(joint.servo_id, HARDWARE_ERROR)
            talk.reboot(joint.servo_id)
            part = "clamp" if isinstance(joint, ClampJoint) else f"joint {number}"
            name = f"servo {joint.servo_id} ({part})"
            errors.append((name, before, talk.read(joint.servo_id, HARDWARE_ERROR)))
    return errors


def _judge_reboot(errors: list[tuple[str, int, int]], vehicle: Vehicle) -> Report:
    lines = [f"{n}: hardware error {hardware_error_text(a)} -> {hardware_error_text(b)}" for n, a, b in errors]
    left = any(after for _, _, after in errors)
    advice = ["an error that remains still has its cause: check supply, temperature and load"] if left else []
    data = {"servos": [{"name": name, "before": before, "after": after} for name, before, after in errors]}
    return Report((), data, lines, advice=advice, ok=not left)


TOOLS: Final[Mapping[str, Tool[Any]]] = {
    "scan": Tool("arm scan", ARM, _scan, _judge_scan, servos_only=True),
    "setup": Tool("arm setup", ARM, arm_setup.set_up, arm_setup.judge, servos_only=True),
    "zero": Tool("arm zero", ARM, _zero, _judge_zero, servos_only=True),
    "jog": Tool("arm jog", ARM, _jog, _judge_jog),
    "reboot": Tool("arm reboot", ARM, _reboot, _judge_reboot, servos_only=True),
    "friction": Tool("arm friction", ARM, _sweep, _judge_sweep, servos_only=True),
}
