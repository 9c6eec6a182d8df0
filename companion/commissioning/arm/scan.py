"""`companion arm scan`: find every servo on the bus and compare it with the vehicle file. Nothing is written."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from companion.commissioning.arm import bus
from companion.commissioning.arm.bus import ServoTalk
from companion.commissioning.arm.servo import (
    SETTINGS,
    Assignment,
    ClampJoint,
    FoundServo,
    Scan,
    assign,
    expected_models,
    is_strange,
    settings,
    with_clamp,
)
from companion.commissioning.tool import Session
from companion.config.arm import Arm
from companion.config.base import Location
from companion.config.devices import ArmDevice
from companion.config.document import Data
from companion.config.vehicle import Vehicle
from companion.io.dynamixel import registers as dxl
from companion.io.dynamixel.port import usb_latency_ms
from companion.io.protocols import DeviceError
from companion.model.check_row import Row
from companion.model.servos import hardware_error_text, kind_of, model_text
from companion.preflight import arm as preflight
from companion.preflight.checks import Check

SEARCHED: tuple[int, ...] = tuple(reversed(bus.BAUDS))
"""Baud rates of a full scan, in this order, after the vehicle file's rate."""

IDS = Check("arm.scan.ids", "servo ids", why=preflight.DEVICE.why)
BAUD = Check("arm.scan.baud", "baud rate", why="servos at a different rate receive nothing")
COLLISION = Check("arm.scan.collision", "one servo per id", why="colliding answers are lost")
MODEL = Check("arm.scan.model", "servo models", why=preflight.MODEL.why)
FIRMWARE = Check("arm.scan.firmware", "servo firmware", why=preflight.FIRMWARE.why)
ERROR = Check("arm.scan.error", "servo hardware error", why=preflight.ERROR.why)
VOLTAGE = Check("arm.scan.voltage", "servo supply", why=preflight.VOLTAGE.why)
TEMPERATURE = Check("arm.scan.temperature", "servo temperature", why=preflight.TEMPERATURE.why, warns=True)
USB = Check("arm.scan.usb_latency", "USB latency timer", why=preflight.USB.why, warns=True)
WATCHDOG = Check(
    "arm.scan.watchdog",
    "bus watchdog",
    why="a servo whose watchdog has tripped produces no torque until it is cleared; the companion arms the watchdog in every flight",
    warns=True,
)
_SETUP: Final = "companion arm setup"


@dataclass(frozen=True, slots=True)
class Judgement:
    """A scan compared with a vehicle file."""

    rows: tuple[Row, ...]
    assignment: Assignment
    changes: Mapping[Location, Data]
    """Values of the servos that the vehicle file could adopt."""


def scan_for(session: Session, only: int | None = None) -> Scan:
    """Scan the vehicle file's port and show the progress. `only`: as in `scan`."""
    device = session.vehicle.arm_device
    where = "every baud rate" if only is None else f"{only} baud only"
    session.say(f"{device.port}: searching for servos at {where}; nothing is written, and torque stays off")
    with session.console.status("searching for servos") as status:
        return scan(device, progress=lambda text: status.update(f"searching for servos at {text}"), only=only)


def scan(device: ArmDevice, *, progress: Callable[[str], None] = lambda _: None, only: int | None = None) -> Scan:
    """Ping at every baud rate and read the registers of every servo that answers. Nothing is written; torque stays off.

    Args:
        device: port, and the baud rate that is tried first.
        only: the one baud rate to try; None for all.

    Raises:
        DeviceError: the port cannot be opened, or fails.
    """
    bauds = [device.baud, *(baud for baud in SEARCHED if baud != device.baud)] if only is None else [only]
    servos: list[FoundServo] = []
    garbled: list[int] = []
    tried: list[int] = []
    with ServoTalk(device.servo_port) as talk:
        for baud in bauds:
            if only is None and baud < bus.FACTORY_BAUD and len(servos) > 1:
                break  # 5 s for a rate that is rarely used
            progress(f"{baud} baud")
            talk.open(baud)
            answers = talk.answers_to_ping()
            tried.append(baud)
            found = [_read(talk, *answer) for answer in answers.servos]
            servos += found
            unreadable = any(kind_of(one.model) is not None and not one.registers for one in found)
            if answers.garbled or unreadable:
                garbled.append(baud)
    return Scan(tuple(tried), tuple(servos), tuple(garbled), usb_latency_ms(device.port))


def _read(talk: ServoTalk, servo_id: int, model: int, firmware: int) -> FoundServo:
    """Read the registers of a servo that answered a ping; read none if its model is not supported or it no longer answers."""
    registers: dict[str, int] = {}
    if kind_of(model) is not None:
        try:
            registers = {register.name: talk.read(servo_id, register) for register in SETTINGS}
        except DeviceError:
            registers = {}
    return FoundServo(servo_id=servo_id, baud=talk.baud, model=model, firmware=firmware, registers=registers)


def judge(found: Scan, vehicle: Vehicle) -> Judgement:
    """Compare a scan with the vehicle file."""
    arm, device = with_clamp(vehicle), vehicle.arm_device
    who = assign(found.servos, arm)
    present = [(index, servo) for index, servo in enumerate(who.joints) if servo is not None]
    rows = [_collision(found, arm), _ids(found, who, arm), *_models(found, arm), *_bauds(found, device)]
    if present:
        rows += _states([servo for _, servo in present], vehicle)
    for index, servo in present:
        rows += _settings(index, servo, arm, device)
    rows.append(preflight.usb_latency(USB, found.latency_ms))
    return Judgement(tuple(rows), who, {} if found.garbled_at else _changes(who, arm, device))


def _changes(who: Assignment, arm: Arm, device: ArmDevice) -> dict[Location, Data]:
    changes: dict[Location, Data] = {}
    servo = None if who.renamed is None else who.joints[who.renamed]
    if who.renamed is not None and servo and servo.servo_id not in [joint.servo_id for joint in arm.joints]:
        clamp = isinstance(arm.joints[who.renamed], ClampJoint)
        key: Location = ("tool", "jaws") if clamp else ("arm", "joints", who.renamed)
        changes[*key, "servo_id"] = servo.servo_id
    bauds = {servo.baud if servo else 0 for servo in who.joints}
    if len(bauds) == 1 and device.baud not in bauds and min(bauds) >= bus.FACTORY_BAUD:
        changes["devices", "arm", "baud"] = bauds.pop()
    return changes


def one_at_a_time(arm: Arm) -> str:
    """Return how to set up servos that cannot be told apart."""
    count = len(arm.joints)
    more = f"; then only that of joint 2: {_SETUP} --joint 2" if count == 2 else f"; then likewise up to joint {count}"
    return f"connect only the servo of joint 1: {_SETUP} --joint 1{more if count > 1 else ''}"


def _collision(found: Scan, arm: Arm) -> Row:
    if not found.garbled_at:
        return COLLISION.good("every answer is readable", "readable answers")
    where = " and ".join(map(str, found.garbled_at))
    fix = f"two servos may share one id: {one_at_a_time(arm)}; otherwise check for a bad cable or ground"
    return COLLISION.bad(f"unreadable answers at {where} baud", "readable answers", fix)


def _ids(found: Scan, who: Assignment, arm: Arm) -> Row:
    one_rate = f"{found.bauds[0]} baud" if len(found.bauds) == 1 else ""
    where = f"at {one_rate}" if one_rate else f"from {min(found.bauds)} to {max(found.bauds)} baud"
    read = ", ".join(f"{servo.servo_id} at {servo.baud} baud" for servo in found.servos) or f"no servo answers, {where}"
    wanted = " and ".join(str(joint.servo_id) for joint in arm.joints)
    missing = [index for index, servo in enumerate(who.joints) if servo is None]
    if who.renamed is not None and (servo := who.joints[who.renamed]):
        now, new = servo.servo_id, arm.joints[who.renamed].servo_id
        fix = f"{_SETUP} gives servo {now} the id {new}; or keep it and change the vehicle file to {now}"
        return IDS.bad(read, wanted, fix)
    if not missing:
        return IDS.good(read, wanted)
    if found.garbled_at or (len(missing) > 1 and len(who.others) > 1):
        return IDS.bad(read, wanted, one_at_a_time(arm))
    ids = " and ".join(str(arm.joints[index].servo_id) for index in missing)
    if one_rate:
        fix = f"servo {ids} does not answer at {one_rate}: companion arm scan without --baud tries all rates"
        return IDS.bad(read, wanted, fix)
    fix = f"servo {ids} does not answer at any baud rate: check its power and both plugs of its cable"
    return IDS.bad(read, wanted, fix)


def _models(found: Scan, arm: Arm) -> Iterator[Row]:
    strange = [servo for servo in found.servos if is_strange(servo, arm)]
    for servo in strange:
        read = f"id {servo.servo_id}: {model_text(servo.model)}"
        wanted = " or ".join(expected_models(servo, arm))
        fix = f"install an {wanted}, correct arm.joints[].servo, or remove this servo from the bus"
        kind = kind_of(servo.model)
        if kind is not None and kind.name in expected_models(servo, arm):
            read = f"id {servo.servo_id}: answers a ping, but not all reads"
            fix = "another program may be using the bus: close it; otherwise cycle the servo's power"
        yield MODEL.bad(read, wanted, fix)
    if found.servos and not strange:
        names = ", ".join(dict.fromkeys(servo.kind.name for servo in found.servos))
        yield MODEL.good(names, ", ".join(dict.fromkeys(joint.kind.name for joint in arm.joints)))


def _bauds(found: Scan, device: ArmDevice) -> Iterator[Row]:
    bauds = {servo.baud for servo in found.servos}
    if not bauds:
        return
    if bauds == {device.baud}:
        yield BAUD.good(str(device.baud), str(device.baud))
        return
    read = ", ".join(f"servo {servo.servo_id} at {servo.baud}" for servo in found.servos)
    fix = f"{_SETUP} sets every servo to {device.baud}"
    if len(bauds) == 1 and min(bauds) >= bus.FACTORY_BAUD:
        fix += f"; or change the vehicle file to {min(bauds)}"
    yield BAUD.bad(read, str(device.baud), fix)


def _states(servos: Sequence[FoundServo], vehicle: Vehicle) -> list[Row]:
    tripped = [servo for servo in servos if servo.value(dxl.BUS_WATCHDOG) == dxl.WATCHDOG_TRIPPED]
    errors = [servo.value(dxl.HARDWARE_ERROR) for servo in servos]
    temperatures_c = [servo.value(dxl.PRESENT_TEMPERATURE) for servo in servos]
    warn_c = vehicle.safety.servo_warn_c
    return [
        preflight.firmware(FIRMWARE, [(servo.kind, servo.firmware) for servo in servos]),
        ERROR.row(
            not any(errors),
            _each(servos, [hardware_error_text(error) for error in errors]),
            "none",
            "remove the cause, then run companion arm reboot",
        ),
        WATCHDOG.row(
            not tripped,
            _each(servos, ["tripped" if servo in tripped else "not tripped" for servo in servos]),
            "not tripped",
            f"{_SETUP} clears it; it tripped because the companion died or a cable was pulled while torque was on",
        ),
        preflight.supply(
            VOLTAGE, [(servo.kind, servo.value(dxl.PRESENT_VOLTAGE) * dxl.VOLTAGE_UNIT_V) for servo in servos]
        ),
        TEMPERATURE.row(
            max(temperatures_c) < warn_c,
            _each(servos, [f"{temperature_c} degC" for temperature_c in temperatures_c]),
            f"below {warn_c:g} degC",
            "let the arm cool down; check for a jammed joint or a load on the arm",
        ),
    ]


def _settings(index: int, servo: FoundServo, arm: Arm, device: ArmDevice) -> Iterator[Row]:
    """Return one row per setting of a joint's servo; id and baud rate have rows of their own."""
    for setting in settings(servo, index, arm, device):
        if setting.register not in (bus.ID, bus.BAUD):
            name = setting.register.name
            key = f"arm.scan.joint{index + 1}.{name.replace(' ', '_').lower()}"
            check = Check(key, f"joint {index + 1}: {name}", why=setting.why)
            yield check.row(setting.right, setting.shown(setting.found), setting.shown(setting.wanted), _SETUP)


def _each(servos: Sequence[FoundServo], texts: Sequence[str]) -> str:
    """Return the common text of all servos, or each servo's text with its id if they differ."""
    if len(set(texts)) == 1:
        return texts[0]
    return ", ".join(f"id {servo.servo_id}: {text}" for servo, text in zip(servos, texts, strict=True))


def _found(found: Scan, judged: Judgement) -> list[dict[str, Any]]:
    joints = {id(servo): index + 1 for index, servo in enumerate(judged.assignment.joints) if servo is not None}
    return [{**servo.as_json(), "joint": joints.get(id(servo))} for servo in found.servos]


def table(found: Scan, judged: Judgement) -> list[str]:
    """Return the servos as lines for display."""
    layout = "{:>4}  {:>8}  {:<10}  {:>8}  {:>5}  {:>8}  {:>11}  {:>6}"
    lines = [layout.format("id", "baud", "model", "firmware", "joint", "position", "temperature", "supply")]
    for servo, about in zip(found.servos, _found(found, judged), strict=True):
        kind = kind_of(servo.model)
        cells: list[object] = [
            servo.servo_id,
            servo.baud,
            kind.name if kind is not None else servo.model,
            servo.firmware,
        ]
        cells += [about["joint"] or "-", about.get("position_counts", "-")]
        cells += [f"{about['temperature_c']} degC", f"{about['voltage_v']} V"] if servo.registers else ["-", "-"]
        lines.append(layout.format(*cells))
    return [*lines, ""] if found.servos else []


def as_json(found: Scan, judged: Judgement) -> dict[str, Any]:
    """Return the scan's part of the JSON document."""
    return {
        "bauds": list(found.bauds),
        "garbled_at": list(found.garbled_at),
        "usb_latency_ms": found.latency_ms,
        "servos": _found(found, judged),
    }
