"""`companion arm scan` and `companion arm setup`, from beginning to end."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from companion.commissioning.arm.bus import BAUDS
from companion.commissioning.arm.result import finish
from companion.commissioning.arm.scan import Judgement, judge, scan, scan_json
from companion.commissioning.arm.screen import ask, people_console, say, show_rows
from companion.commissioning.arm.servo import Scan, settings
from companion.commissioning.arm.setup import ServoPlan, SetupPlan, carry_out, plan
from companion.config.document import ConfigError
from companion.config.vehicle import Vehicle
from companion.model.exit_codes import EXIT_ABORTED
from companion.model.rows import Level


def run_scan(arguments: argparse.Namespace, vehicle: Vehicle) -> int:
    """Find, compare, propose.

    Raises:
        DeviceError: the port does not open.
        ConfigError: the proposed change does not fit the vehicle file; --baud is no rate of these servos.
    """
    if arguments.baud not in (None, *BAUDS):
        raise ConfigError([f"--baud {arguments.baud}: expected one of {', '.join(map(str, BAUDS))}"])
    people = people_console(arguments.json)
    found = _scan(people, vehicle, arguments.baud)
    judged = judge(found, vehicle)
    _show_servos(people, found, judged)
    show_rows(people, judged.rows, {f"arm.scan.joint{n}": f"joint {n}: settings" for n in (1, 2)})
    wrong = {row.id for row in judged.rows if not row.ok and row.level is not Level.WARN}
    if not wrong:
        say(people, "the servos are as the vehicle file says", "bold green")
    left = wrong - {"arm.scan.baud" if "baud" in location else "arm.scan.ids" for location in judged.changes}
    return finish(
        arguments, people, not left, judged.changes, scan_json(found, judged), instead="companion arm setup for this"
    )


def run_setup(arguments: argparse.Namespace, vehicle: Vehicle) -> int:
    """Scan, show what would be written, ask, write, scan again.

    Raises:
        DeviceError: no answer where there was one before; scan again.
    """
    people = people_console(arguments.json)
    joint: int | None = arguments.joint
    at_terminal = sys.stdin is not None and sys.stdin.isatty() and not arguments.yes and not arguments.json
    say(people, "setup: torque stays off; what is to be written is shown first", "bold")
    wanted = _plan(people, vehicle, joint)
    if wanted.one_at_a_time and joint is None and at_terminal:
        return _one_by_one(arguments, people, vehicle, wanted)
    return _set_up(arguments, people, vehicle, wanted)


def _plan(people: Console, vehicle: Vehicle, joint: int | None) -> SetupPlan:
    return plan(_scan(people, vehicle), vehicle.arm, vehicle.devices.arm, joint)


def _one_by_one(arguments: argparse.Namespace, people: Console, vehicle: Vehicle, why: SetupPlan) -> int:
    say(people, why.refusal, "yellow")
    for joint in (0, 1):
        say(
            people,
            f"connect only the servo of joint {joint + 1} ({('shoulder', 'elbow')[joint]}), then press Enter",
            "bold",
        )
        if not sys.stdin.readline():
            return EXIT_ABORTED
        code = _set_up(arguments, people, vehicle, _plan(people, vehicle, joint))
        if code:
            return code
    say(people, "connect both, then press Enter", "bold")
    if not sys.stdin.readline():
        return EXIT_ABORTED
    return _set_up(arguments, people, vehicle, _plan(people, vehicle, None))


def _set_up(arguments: argparse.Namespace, people: Console, vehicle: Vehicle, wanted: SetupPlan) -> int:
    if wanted.refusal:
        say(people, wanted.refusal, "bold red")
        return finish(arguments, people, False, {}, _setup_json(wanted, "refused"))
    needed = [one for one in wanted.servos if one.needed]
    _show_plan(people, wanted.servos)
    for index in wanted.absent:
        say(
            people,
            f"servo {vehicle.arm.joints[index].servo_id} (joint {index + 1}) does not answer: check its power and cable",
            "bold red",
        )
    if not needed:
        say(people, "nothing to write: every servo that answers is as the companion wants it", "green")
        return finish(arguments, people, not wanted.absent, {}, _setup_json(wanted, "nothing to do"))
    if not arguments.yes:
        answer = ask(people, f"write this to {len(needed)} servo{'s' if len(needed) > 1 else ''}?")
        if answer is not True:
            say(
                people,
                "nothing was written" + ("" if answer is False else "; --yes writes it without asking"),
                "yellow",
            )
            code = finish(arguments, people, False, {}, _setup_json(wanted, "not written"))
            return EXIT_ABORTED if answer is False else code
    carry_out(vehicle.devices.arm.port, tuple(needed), lambda text: say(people, f"  {text}"))
    left = _left(people, vehicle, wanted)
    for line in left:
        say(people, line, "bold red")
    if any(one.turns_over for one in needed):
        say(people, "a servo counts otherwise than before: run companion arm zero", "yellow")
    done = not left and not wanted.absent
    if done:
        say(people, "set up and read back", "bold green")
    return finish(arguments, people, done, {}, _setup_json(wanted, "written"))


def _left(people: Console, vehicle: Vehicle, wanted: SetupPlan) -> list[str]:
    """What is not as it was to be, by another look at the bus, one line each."""
    say(people, "reading back")
    arm, device = vehicle.arm, vehicle.devices.arm
    servos = {servo.servo_id: servo for servo in scan(device, only=device.baud).servos if servo.is_xm430}
    lines: list[str] = []
    for one in wanted.servos:
        servo_id = arm.joints[one.joint].servo_id
        servo = servos.get(servo_id)
        if servo is None:
            lines.append(
                f"servo {servo_id}: does not answer at {device.baud} baud afterwards; companion arm scan finds it"
            )
            continue
        for setting in settings(servo, arm.joints[one.joint], arm, device):
            if not setting.fine:
                text = f"reads {setting.shown(setting.found)} afterwards, wanted {setting.shown(setting.wanted)}"
                lines.append(f"servo {servo_id}: {setting.register} {text}; run companion arm setup again")
    return lines


def _scan(people: Console, vehicle: Vehicle, baud: int | None = None) -> Scan:
    device = vehicle.devices.arm
    where = "every baud rate" if baud is None else f"{baud} baud alone"
    say(people, f"{device.port}: every servo at {where}; nothing is written, nothing gets torque")
    with people.status("looking for servos") as status:
        return scan(device, progress=lambda text: status.update(f"looking for servos at {text}"), only=baud)


def _show_servos(people: Console, found: Scan, judged: Judgement) -> None:
    if not found.servos:
        return
    table = Table(box=None, pad_edge=False, header_style="bold")
    names = ("id", "baud", "model", "firmware", "joint", "position", "temperature", "supply")
    for name in names:
        table.add_column(name)
    for servo in found.servos:
        about = servo.as_json()
        joint = next((str(index + 1) for index, one in enumerate(judged.assignment.joints) if one is servo), "-")
        cells = [servo.servo_id, servo.baud, "XM430-W210" if servo.is_xm430 else servo.model, servo.firmware, joint]
        if servo.registers:
            cells += [about["position_counts"], f"{about['temperature_c']} degC", f"{about['voltage_v']} V"]
        table.add_row(*(Text(str(cell)) for cell in cells))
    people.print(table)
    people.print()


def _show_plan(people: Console, plans: tuple[ServoPlan, ...]) -> None:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("joint", "servo", "setting", "before", "after", "why"):
        table.add_column(name, overflow="fold")
    for one in plans:
        for setting in one.writes:
            names = (str(one.joint + 1), str(one.servo.servo_id), str(setting.register))
            cells = (*names, setting.shown(setting.found), setting.shown(setting.wanted), setting.why)
            table.add_row(*map(Text, cells))
    if table.row_count:
        people.print(table)
    for one in plans:
        which = "all" if not one.writes else "the other"
        count = len(one.settings) - len(one.writes)
        say(people, f"joint {one.joint + 1}, servo {one.servo.servo_id}: {which} {count} settings are as they must be")
        if one.wake:
            say(
                people,
                f"joint {one.joint + 1}, servo {one.servo.servo_id}: torque is on, or its bus watchdog is: both are ended",
            )


def _setup_json(wanted: SetupPlan, outcome: str) -> dict[str, Any]:
    return {
        "outcome": outcome,
        "refusal": wanted.refusal,
        "absent_joints": [index + 1 for index in wanted.absent],
        "servos": [one.as_json() for one in wanted.servos],
    }
