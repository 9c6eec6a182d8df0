"""`companion arm scan`: find every servo on the bus, compare it with the vehicle file, say what puts it right. Nothing is written."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.commissioning.arm import bus
from companion.commissioning.arm.bus import Heard, ServoTalk
from companion.commissioning.arm.servo import SETTINGS, Assignment, FoundServo, Scan, assign, settings
from companion.config.base import Location
from companion.config.document import Data
from companion.config.vehicle import Arm, ArmDevice, Vehicle
from companion.io.dynamixel import registers as dxl
from companion.io.protocols import DeviceError
from companion.model.rows import Row
from companion.preflight import arm as preflight
from companion.preflight.checks import Check

SYSFS = Path("/sys/class/tty")

_NO_ARM = "no arm, no flight"
IDS = Check("arm.scan.ids", "servo ids", "those of arm.joints[].servo_id", _NO_ARM)
BAUD = Check("arm.scan.baud", "baud rate", "devices.arm.baud", "servos at another rate hear nothing")
COLLISION = Check("arm.scan.collision", "one servo an id", "every answer can be read", "two answers at once are none")
MODEL = Check("arm.scan.model", "servo models", "XM430-W210 (model 1030)", preflight.MODEL.why)
FIRMWARE = Check("arm.scan.firmware", "servo firmware", "38 or newer, the same on both", preflight.FIRMWARE.why)
ERROR = Check("arm.scan.error", "servo hardware error", "none (register 70)", preflight.ERROR.why)
VOLTAGE = Check("arm.scan.voltage", "servo supply", "10.0 to 14.8 V", preflight.VOLTAGE.why)
TEMPERATURE = Check("arm.scan.temperature", "servo temperature", "below safety.servo_warn_c", preflight.TEMPERATURE.why)
USB = Check("arm.scan.usb_latency", "USB latency timer", "1 ms, or no FTDI adapter", preflight.USB.why, warns=True)
WATCHDOG = Check(
    "arm.scan.watchdog",
    "bus watchdog",
    "not let go (register 98)",
    "one that let go takes no torque until it is cleared; the companion starts it in every flight",
    warns=True,
)
_SETUP = "companion arm setup"


@dataclass(frozen=True, slots=True)
class Judgement:
    """What a scan means for a vehicle file."""

    rows: tuple[Row, ...]
    assignment: Assignment
    changes: dict[Location, Data]
    """For the vehicle file, where it is the file that could give way."""
    one_at_a_time: bool
    """Nobody can say who is which joint's as long as both are connected."""


def scan(
    device: ArmDevice, *, progress: Callable[[str], None] = lambda _: None, sysfs: Path = SYSFS, only: int | None = None
) -> Scan:
    """Ping at every baud rate and read what answers. Nothing is written, nothing gets torque.

    Args:
        device: its port; its baud rate is tried first.
        progress: told what is being tried.
        sysfs: where the kernel tells latency timers.
        only: the one baud rate to look at; None: all.

    Raises:
        DeviceError: the port does not open, or dies.
    """
    all_bauds = [device.baud, *(baud for baud in reversed(bus.BAUDS) if baud != device.baud)]
    bauds = all_bauds if only is None else [only]
    servos: list[FoundServo] = []
    garbled: list[int] = []
    tried: list[int] = []
    with ServoTalk(device.port) as talk:
        for baud in bauds:
            if only is None and baud < bus.FACTORY_BAUD and len(servos) > 1:
                break  # 5 s for a rate that nobody sets on purpose
            progress(f"{baud} baud")
            talk.open(baud)
            heard = talk.heard()
            tried.append(baud)
            found, unreadable = _read_all(talk, heard)
            servos += found
            if heard.garbled or unreadable:
                garbled.append(baud)
    return Scan(tuple(tried), tuple(servos), tuple(garbled), dxl.usb_latency_ms(device.port, sysfs))


def _read_all(talk: ServoTalk, heard: Heard) -> tuple[list[FoundServo], bool]:
    """Everybody's registers, and whether somebody who had answered the ping could not be read."""
    servos, unreadable = [], False
    for servo_id, model, firmware in heard.servos:
        registers: dict[str, int] = {}
        if model == dxl.MODEL_NUMBER_XM430_W210:
            try:
                registers = {register.name: talk.read(servo_id, register) for register in SETTINGS}
            except DeviceError:
                unreadable = True
        servos.append(FoundServo(servo_id, heard.baud, model, firmware, registers))
    return servos, unreadable


def judge(found: Scan, vehicle: Vehicle) -> Judgement:
    """Compare with the vehicle file."""
    arm, device = vehicle.arm, vehicle.devices.arm
    who = assign(found.servos, arm)
    missing = [index for index, servo in enumerate(who.joints) if servo is None]
    one_at_a_time = bool(found.garbled_at) or (len(missing) == 2 and len(who.others) > 1)
    changes = _changes(found, who, arm, device) if not found.garbled_at else {}
    rows = [*_who_rows(found, who, arm, one_at_a_time), *_baud_rows(found, device)]
    present = [(index, servo) for index, servo in enumerate(who.joints) if servo is not None]
    if present:
        rows += _state_rows([servo for _, servo in present], vehicle)
    for index, servo in present:
        rows += _setting_rows(index, servo, arm, device)
    rows.append(preflight.usb_latency(USB, found.latency_ms))
    return Judgement(tuple(rows), who, changes, one_at_a_time)


def _changes(found: Scan, who: Assignment, arm: Arm, device: ArmDevice) -> dict[Location, Data]:
    changes: dict[Location, Data] = {}
    if who.renamed is not None:
        servo = who.joints[who.renamed]
        assert servo is not None
        changes[("arm", "joints", who.renamed, "servo_id")] = servo.servo_id
    bauds = {servo.baud for servo in who.joints if servo is not None}
    if None not in who.joints and len(bauds) == 1 and device.baud not in bauds:
        baud = bauds.pop()
        if baud >= bus.FACTORY_BAUD:
            changes[("devices", "arm", "baud")] = baud
    return changes


def _who_rows(found: Scan, who: Assignment, arm: Arm, one_at_a_time: bool) -> Iterator[Row]:
    told = [f"{servo.servo_id} at {servo.baud} baud" for servo in found.servos]
    one_rate = f"{found.bauds[0]} baud" if len(found.bauds) == 1 else ""
    read = ", ".join(told) if told else f"nobody answers, {f'at {one_rate}' if one_rate else _span(found.bauds)}"
    wanted = " and ".join(str(joint.servo_id) for joint in arm.joints)
    missing = [index for index, servo in enumerate(who.joints) if servo is None]
    one = f"connect only the servo of joint 1: {_SETUP} --joint 1; then only that of joint 2: {_SETUP} --joint 2"
    if found.garbled_at:
        where = " and ".join(f"{baud}" for baud in found.garbled_at)
        fix = f"two servos may have one id: {one}; else look for a bad cable or ground"
        yield COLLISION.bad(f"answers that nobody can read at {where} baud", "readable answers", fix)
    else:
        yield COLLISION.good("every answer can be read", "readable answers")
    if who.renamed is not None:
        servo = who.joints[who.renamed]
        joint = arm.joints[who.renamed]
        assert servo is not None
        fix = f"{_SETUP} gives servo {servo.servo_id} the id {joint.servo_id}; or keep it and let the vehicle file say {servo.servo_id}"
        yield IDS.bad(read, wanted, fix)
    elif missing and one_at_a_time:
        yield IDS.bad(read, wanted, one)
    elif missing:
        ids = " and ".join(str(arm.joints[index].servo_id) for index in missing)
        fix = f"servo {ids} does not answer at any baud rate: check its power and both plugs of its cable"
        if one_rate:
            fix = f"servo {ids} does not answer at {one_rate}: companion arm scan without --baud looks at all rates"
        yield IDS.bad(read, wanted, fix)
    else:
        yield IDS.good(read, wanted)
    strange = [servo for servo in found.servos if not servo.is_xm430]
    for servo in strange:
        if servo.model == dxl.MODEL_NUMBER_XM430_W210:
            fix = "another program may be on the bus: close that; else cycle the servo's power"
            yield MODEL.bad(f"id {servo.servo_id}: answers a ping, but not all reads", "XM430-W210", fix)
        else:
            fix = "build in an XM430-W210, or take it off this bus"
            yield MODEL.bad(f"id {servo.servo_id}: model {servo.model}", "XM430-W210", fix)
    if found.servos and not strange:
        yield MODEL.good("XM430-W210", "XM430-W210")


def _span(bauds: tuple[int, ...]) -> str:
    return f"from {min(bauds)} to {max(bauds)} baud"


def _baud_rows(found: Scan, device: ArmDevice) -> Iterator[Row]:
    if not found.servos:
        return
    others = sorted({servo.baud for servo in found.servos} - {device.baud})
    if not others:
        yield BAUD.good(str(device.baud), str(device.baud))
        return
    read = ", ".join(f"servo {servo.servo_id} at {servo.baud}" for servo in found.servos)
    fix = f"{_SETUP} brings every servo to {device.baud}"
    if len({servo.baud for servo in found.servos}) == 1 and others[0] >= bus.FACTORY_BAUD:
        fix += f"; or let the vehicle file say {others[0]}"
    yield BAUD.bad(read, str(device.baud), fix)


def _state_rows(servos: list[FoundServo], vehicle: Vehicle) -> Iterator[Row]:
    firmwares = [servo.firmware for servo in servos]
    read, wanted = (
        _each(servos, lambda servo: str(servo.firmware)),
        f"{preflight.FIRMWARE_MIN} or newer, the same on both",
    )
    fix = "update with DYNAMIXEL Wizard: Recovery, newest firmware"
    if min(firmwares) < preflight.FIRMWARE_MIN:
        yield FIRMWARE.bad(read, wanted, fix)
    elif len(set(firmwares)) > 1:
        yield FIRMWARE.doubtful(read, wanted, fix)
    else:
        yield FIRMWARE.good(read, wanted)
    errors = [servo.value(dxl.HARDWARE_ERROR) for servo in servos]
    read = _each(servos, lambda servo: dxl.hardware_error_text(servo.value(dxl.HARDWARE_ERROR)))
    fix = "remove the cause, then cycle the servos' power"
    yield ERROR.bad(read, "none", fix) if any(errors) else ERROR.good(read, "none")
    tripped = [servo for servo in servos if servo.value(dxl.BUS_WATCHDOG) == dxl.WATCHDOG_TRIPPED]
    read = _each(servos, lambda servo: "let go" if servo in tripped else "quiet")
    fix = f"{_SETUP} clears it; a companion that died, or a cable that was pulled under torque, is its cause"
    yield WATCHDOG.bad(read, "quiet", fix) if tripped else WATCHDOG.good(read, "quiet")
    volts = [servo.value(dxl.PRESENT_VOLTAGE) * dxl.VOLTAGE_UNIT_V for servo in servos]
    read = _each(servos, lambda servo: f"{servo.value(dxl.PRESENT_VOLTAGE) * dxl.VOLTAGE_UNIT_V:.1f} V")
    wanted = f"{preflight.VOLTAGE_MIN_V:g} to {preflight.VOLTAGE_MAX_V:g} V"
    fix = "feed the servos with 12 V from a converter; check its plugs"
    within = all(preflight.VOLTAGE_MIN_V <= volt <= preflight.VOLTAGE_MAX_V for volt in volts)
    yield VOLTAGE.good(read, wanted) if within else VOLTAGE.bad(read, wanted, fix)
    hottest_c, warn_c = max(servo.value(dxl.PRESENT_TEMPERATURE) for servo in servos), vehicle.safety.servo_warn_c
    read, wanted = _each(servos, lambda servo: f"{servo.value(dxl.PRESENT_TEMPERATURE)} degC"), f"below {warn_c:g} degC"
    fix = "let the arm cool down; look for a joint that jams or an arm that leans on something"
    yield TEMPERATURE.good(read, wanted) if hottest_c < warn_c else TEMPERATURE.doubtful(read, wanted, fix)


def _setting_rows(index: int, servo: FoundServo, arm: Arm, device: ArmDevice) -> Iterator[Row]:
    """One row per setting of a joint's servo; id and baud rate have rows of their own."""
    for setting in settings(servo, arm.joints[index], arm, device):
        if setting.register in (bus.ID, bus.BAUD):
            continue
        name = setting.register.name.replace(" ", "_").lower()
        check = Check(
            f"arm.scan.joint{index + 1}.{name}", f"joint {index + 1}: {setting.register.name}", "", setting.why
        )
        read, wanted = setting.shown(setting.found), setting.shown(setting.wanted)
        yield check.good(read, wanted) if setting.fine else check.bad(read, wanted, _SETUP)


def _each(servos: list[FoundServo], text: Callable[[FoundServo], str]) -> str:
    """One text if all have it, else each with its id."""
    texts = [text(servo) for servo in servos]
    if len(set(texts)) == 1:
        return texts[0]
    return ", ".join(f"id {servo.servo_id}: {one}" for servo, one in zip(servos, texts, strict=True))


def scan_json(found: Scan, judged: Judgement) -> dict[str, Any]:
    """For `--json`."""
    joints = {id(servo): index + 1 for index, servo in enumerate(judged.assignment.joints) if servo is not None}
    return {
        "bauds": list(found.bauds),
        "garbled_at": list(found.garbled_at),
        "usb_latency_ms": found.latency_ms,
        "servos": [{**servo.as_json(), "joint": joints.get(id(servo))} for servo in found.servos],
        "rows": [row.as_json() for row in judged.rows],
    }
