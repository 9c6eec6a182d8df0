"""`companion arm setup`: writes the required settings to each servo with torque off and reads them back; the baud rate comes last.

`companion arm scan` can find the servos after every step, so an interrupted setup can be repeated.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rich.table import Table
from rich.text import Text

from companion.commissioning.arm import bus
from companion.commissioning.arm.bus import ServoTalk
from companion.commissioning.arm.scan import one_at_a_time, scan, scan_for
from companion.commissioning.arm.servo import (
    FoundServo,
    Scan,
    Setting,
    assign,
    baud_text,
    expected_models,
    is_strange,
    joint_in,
    settings,
    with_clamp,
)
from companion.commissioning.tool import Cancelled, Report, Session
from companion.config.arm import Arm
from companion.config.devices import ArmDevice
from companion.config.vehicle import Vehicle
from companion.io.dynamixel import registers as dxl
from companion.io.protocols import DeviceError
from companion.model.servos import model_text


@dataclass(frozen=True, slots=True)
class ServoPlan:
    """Settings for one servo."""

    joint: int
    servo: FoundServo
    settings: tuple[Setting, ...]
    """All settings that the companion needs, in the order of writing."""

    @property
    def writes(self) -> tuple[Setting, ...]:
        """Settings that differ."""
        return tuple(setting for setting in self.settings if not setting.right)

    @property
    def wake(self) -> bool:
        """Whether torque or the bus watchdog is on; both are switched off first."""
        return bool(self.servo.value(dxl.TORQUE_ENABLE)) or self.servo.value(dxl.BUS_WATCHDOG) != 0

    @property
    def needed(self) -> bool:
        """Whether anything has to be written."""
        return bool(self.writes) or self.wake

    def as_json(self) -> dict[str, Any]:
        """Return the plan's part of the JSON document."""
        changes = [
            {
                "register": setting.register.address,
                "name": setting.register.name,
                "before": setting.shown(setting.found),
                "after": setting.shown(setting.wanted),
                "why": setting.why,
            }
            for setting in self.writes
        ]
        return {"joint": self.joint + 1, "id": self.servo.servo_id, "baud": self.servo.baud, "changes": changes}


@dataclass(frozen=True, slots=True)
class SetupPlan:
    """Plan of a setup for the servos that were found."""

    servos: tuple[ServoPlan, ...] = ()
    refusal: str = ""
    """Why nothing may be written, with the remedy; empty if the plan may be carried out."""
    one_at_a_time: bool = False
    """Whether the servos have to be connected one at a time."""
    absent: tuple[int, ...] = ()
    """Joints whose servo was not found."""


def plan(found: Scan, arm: Arm, device: ArmDevice, joint: int | None = None) -> SetupPlan:
    """Plan a setup.

    Args:
        found: a scan of all baud rates.
        joint: index of the joint to which the one connected servo belongs regardless of its id; None to assign by id.
    """
    alone = one_at_a_time(arm)
    if joint is not None:
        alone = f"connect only the servo of joint {joint + 1} and run companion arm setup --joint {joint + 1} again"
    if found.garbled_at:
        where = " and ".join(map(str, found.garbled_at))
        text = f"unreadable answers at {where} baud, probably from two servos with the same id; {alone}"
        return SetupPlan(refusal=text, one_at_a_time=True)
    strange = [
        servo
        for servo in found.servos
        if (is_strange(servo, arm) if joint is None else not servo.fits(arm.joints[joint]))
    ]
    if strange:
        servo = strange[0]
        models = " or ".join(expected_models(servo, arm)) if joint is None else arm.joints[joint].servo
        text = f"servo {servo.servo_id} at {servo.baud} baud: expected a readable {models}, found {model_text(servo.model)}"
        return SetupPlan(refusal=f"{text}; remove it from the bus, or cycle its power")
    if not found.servos:
        return SetupPlan(
            refusal="no servo answers at any baud rate; check the servos' power and the plugs of the cable"
        )
    if joint is not None:
        if len(found.servos) > 1:
            ids = " and ".join(str(servo.servo_id) for servo in found.servos)
            return SetupPlan(refusal=f"servos {ids} are connected, expected one; {alone}", one_at_a_time=True)
        joints: Sequence[tuple[int, FoundServo | None]] = [(joint, found.servos[0])]
    else:
        who = assign(found.servos, arm)
        if who.others:
            ids = ", ".join(f"{servo.servo_id} at {servo.baud} baud" for servo in found.servos)
            text = f"it is unknown to which joints these servos belong: {ids}; {alone}"
            return SetupPlan(refusal=text, one_at_a_time=True)
        joints = list(enumerate(who.joints))
    return SetupPlan(
        tuple(ServoPlan(i, one, tuple(settings(one, i, arm, device))) for i, one in joints if one),
        absent=tuple(i for i, one in joints if one is None),
    )


def carry_out(port: str, plans: Sequence[ServoPlan], report: Callable[[str], None]) -> None:
    """Write the planned settings to one servo after the other.

    Args:
        report: called with a line for each value that is written.

    Raises:
        DeviceError: a servo does not answer, refuses, or does not store a value; values already written remain.
    """
    with ServoTalk(port) as talk:
        for one in plans:
            if one.needed:
                _carry_out(talk, one, report)


def _carry_out(talk: ServoTalk, one: ServoPlan, report: Callable[[str], None]) -> None:
    talk.open(one.servo.baud)
    servo_id = one.servo.servo_id
    # EEPROM is locked while torque is on; a tripped watchdog rejects goals until it is cleared.
    talk.write(servo_id, dxl.TORQUE_ENABLE, 0)
    talk.write(servo_id, dxl.BUS_WATCHDOG, 0)
    for setting in one.writes:
        register = setting.register
        report(f"servo {servo_id}: {register} {setting.shown(setting.found)} -> {setting.shown(setting.wanted)}")
        if register == bus.ID:
            talk.try_write(servo_id, register, setting.wanted)
            _expect(talk, setting.wanted, f"id {setting.wanted}", f"id {servo_id}")
            servo_id = setting.wanted
        elif register == bus.BAUD:
            talk.try_write(servo_id, register, setting.wanted)
            talk.open(bus.BAUDS[setting.wanted])
            _expect(talk, servo_id, f"{baud_text(setting.wanted)} baud", f"{one.servo.baud} baud")
        else:
            talk.write(servo_id, register, setting.wanted)


def _expect(talk: ServoTalk, servo_id: int, now: str, before: str) -> None:
    if talk.ping(servo_id) is None:
        raise DeviceError(
            f"servo {servo_id}: does not answer with its new {now} (it had {before}); run companion arm scan, which finds it "
            "with either value, then companion arm setup again"
        )


@dataclass(frozen=True, slots=True)
class Done:
    """Result of a setup."""

    plan: SetupPlan
    outcome: str
    text: tuple[str, ...]
    right: bool
    """Whether every servo has the required settings."""


def set_up(session: Session) -> Done:
    """Scan, show the changes, ask, write and scan again; one servo at a time if they cannot be distinguished.

    Raises:
        DeviceError: a servo no longer answers; scan again.
        Cancelled: the user declined to write.
    """
    arm, arguments = with_clamp(session.vehicle), session.arguments
    joint = joint_in(arm, arguments.joint)
    session.say("setup: torque stays off; the changes are shown before they are written", "bold")
    wanted = _plan(session, joint)
    at_terminal = sys.stdin is not None and sys.stdin.isatty() and not arguments.yes and not arguments.json
    if not (wanted.one_at_a_time and joint is None and at_terminal):
        return _set_up(session, wanted)
    session.say(wanted.refusal, "yellow")
    alone = [(index, f"only the servo of joint {index + 1}") for index in range(len(arm.joints))]
    for joint, which in (*alone, (None, "all servos")):
        session.say(f"connect {which}, then press Enter", "bold")
        if not sys.stdin.readline():
            raise Cancelled("ended before all servos were set up")
        done = _set_up(session, _plan(session, joint))
        if not done.right:
            break
    return done


def _plan(session: Session, joint: int | None) -> SetupPlan:
    return plan(scan_for(session), with_clamp(session.vehicle), session.vehicle.arm_device, joint)


def _set_up(session: Session, wanted: SetupPlan) -> Done:
    vehicle = session.vehicle
    if wanted.refusal:
        return Done(wanted, "refused", (wanted.refusal,), right=False)
    needed = [one for one in wanted.servos if one.needed]
    _show(session, wanted.servos)
    for index in wanted.absent:
        servo_id = with_clamp(vehicle).joints[index].servo_id
        session.say(f"servo {servo_id} (joint {index + 1}) does not answer: check its power and cable", "bold red")
    if not needed:
        text = "nothing to write: every servo that answers has the required settings"
        return Done(wanted, "nothing to do", (text,), right=not wanted.absent)
    answer = session.ask(f"write this to {len(needed)} servo{'s' if len(needed) > 1 else ''}?")
    if answer is None:
        return Done(wanted, "not written", ("nothing was written; --yes writes without asking",), right=False)
    if not answer:
        raise Cancelled("nothing was written")
    carry_out(vehicle.arm_device.servo_port, needed, lambda text: session.say(f"  {text}"))
    session.say("reading back")
    lines = _left(vehicle, wanted)
    right = not lines and not wanted.absent
    if any(setting.register in (dxl.DRIVE_MODE, dxl.HOMING_OFFSET) for one in needed for setting in one.writes):
        lines.append("a servo's direction or zero has changed: run companion arm zero")
    return Done(wanted, "written", (*lines, *(["all settings are written and read back"] if right else [])), right)


def _left(vehicle: Vehicle, wanted: SetupPlan) -> list[str]:
    """Scan again and return the settings that differ, one line each."""
    arm, device = with_clamp(vehicle), vehicle.arm_device
    servos = {servo.servo_id: servo for servo in scan(device, only=device.baud).servos if servo.registers}
    lines: list[str] = []
    for one in wanted.servos:
        servo_id = arm.joints[one.joint].servo_id
        if servo_id not in servos:
            lines.append(f"servo {servo_id}: no longer answers at {device.baud} baud; find it with companion arm scan")
            continue
        for setting in settings(servos[servo_id], one.joint, arm, device):
            if not setting.right:
                text = f"reads {setting.shown(setting.found)} afterwards, expected {setting.shown(setting.wanted)}"
                lines.append(f"servo {servo_id}: {setting.register} {text}; run companion arm setup again")
    return lines


def _show(session: Session, plans: Sequence[ServoPlan]) -> None:
    table = Table("joint", "servo", "setting", "before", "after", "why", box=None, pad_edge=False)
    for one in plans:
        for setting in one.writes:
            name = (str(one.joint + 1), str(one.servo.servo_id), str(setting.register))
            table.add_row(*map(Text, (*name, setting.shown(setting.found), setting.shown(setting.wanted), setting.why)))
    if table.row_count:
        session.console.print(table)
    for one in plans:
        who = f"joint {one.joint + 1}, servo {one.servo.servo_id}"
        which = "the other" if one.writes else "all"
        session.say(f"{who}: {which} {len(one.settings) - len(one.writes)} settings are correct")
        if one.wake:
            session.say(f"{who}: torque or its bus watchdog is on: both are switched off")


def judge(done: Done, vehicle: Vehicle) -> Report:
    """Return the report of a setup."""
    data = {
        "outcome": done.outcome,
        "refusal": done.plan.refusal,
        "absent_joints": [index + 1 for index in done.plan.absent],
        "servos": [one.as_json() for one in done.plan.servos],
    }
    return Report((), data, done.text, ok=done.right)
