"""`companion arm setup`: bring each servo to what the companion wants. Written with torque off, read back, the baud rate last.

Every step leaves servos that `companion arm scan` finds, so that a setup that was interrupted is begun again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from companion.commissioning.arm import bus
from companion.commissioning.arm.bus import ServoTalk
from companion.commissioning.arm.servo import FoundServo, Scan, Setting, assign, baud_text, settings
from companion.config.vehicle import Arm, ArmDevice
from companion.io.dynamixel import registers as dxl
from companion.io.protocols import DeviceError


@dataclass(frozen=True, slots=True)
class ServoPlan:
    """What one servo is to be set to."""

    joint: int
    servo: FoundServo
    settings: tuple[Setting, ...]
    """All that the companion minds, in the order in which they are written."""
    wake: bool
    """Its bus watchdog has let go, or torque is on: both are ended first."""

    @property
    def writes(self) -> tuple[Setting, ...]:
        """What differs."""
        return tuple(setting for setting in self.settings if not setting.fine)

    @property
    def needed(self) -> bool:
        """There is something to do."""
        return bool(self.writes) or self.wake

    @property
    def turns_over(self) -> bool:
        """Afterwards the servo counts otherwise than before: its zero and sign have to be found again."""
        return any(setting.register in (bus.DRIVE_MODE, bus.HOMING_OFFSET) for setting in self.writes)

    def as_json(self) -> dict[str, Any]:
        """For `--json`."""
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
    """What a setup would do with the servos that were found."""

    servos: tuple[ServoPlan, ...]
    refusal: str
    """Why nothing may be done, with what to do instead; empty: go on."""
    one_at_a_time: bool = False
    """That is: connect one servo alone."""
    absent: tuple[int, ...] = ()
    """Joints whose servo was not there."""


def plan(found: Scan, arm: Arm, device: ArmDevice, joint: int | None = None) -> SetupPlan:
    """Decide, from a scan of all baud rates.

    Args:
        found: the scan.
        arm: joints of the vehicle file.
        device: baud rate of the vehicle file.
        joint: 0 or 1: the one servo that is connected is this joint's, whatever its id; None: by their ids.
    """
    if found.garbled_at:
        where = " and ".join(map(str, found.garbled_at))
        text = f"answers that nobody can read at {where} baud, as from two servos with one id"
        return SetupPlan((), f"{text}; {_alone(joint)}", one_at_a_time=True)
    strange = [servo for servo in found.servos if not servo.is_xm430]
    if strange:
        servo = strange[0]
        text = f"servo {servo.servo_id} at {servo.baud} baud is no XM430-W210 that answers (model {servo.model})"
        return SetupPlan((), f"{text}; take it off this bus, or cycle its power")
    if not found.servos:
        return SetupPlan((), "no servo answers at any baud rate; check their power and the plugs of the cable")
    if joint is not None:
        if len(found.servos) > 1:
            ids = " and ".join(str(servo.servo_id) for servo in found.servos)
            return SetupPlan(
                (), f"servos {ids} are connected, but one alone must be; {_alone(joint)}", one_at_a_time=True
            )
        return SetupPlan((_servo_plan(joint, found.servos[0], arm, device),), "")
    who = assign(found.servos, arm)
    if who.others:
        ids = ", ".join(f"{servo.servo_id} at {servo.baud} baud" for servo in found.servos)
        return SetupPlan(
            (), f"nobody can say which joint's servos these are: {ids}; {_alone(None)}", one_at_a_time=True
        )
    plans = tuple(_servo_plan(index, servo, arm, device) for index, servo in enumerate(who.joints) if servo is not None)
    return SetupPlan(plans, "", absent=tuple(index for index, servo in enumerate(who.joints) if servo is None))


def _alone(joint: int | None) -> str:
    if joint is not None:
        return f"connect only the servo of joint {joint + 1} and run companion arm setup --joint {joint + 1} again"
    return "connect only the servo of joint 1: companion arm setup --joint 1; then only that of joint 2: companion arm setup --joint 2"


def _servo_plan(joint: int, servo: FoundServo, arm: Arm, device: ArmDevice) -> ServoPlan:
    wake = bool(servo.value(dxl.TORQUE_ENABLE)) or servo.value(dxl.BUS_WATCHDOG) != 0
    return ServoPlan(joint, servo, tuple(settings(servo, arm.joints[joint], arm, device)), wake)


def carry_out(port: str, plans: tuple[ServoPlan, ...], tell: Callable[[str], None] = lambda _: None) -> None:
    """Write what the plans say, servo after servo.

    Args:
        port: serial device.
        plans: of one and the same scan.
        tell: told what is being written.

    Raises:
        DeviceError: no answer, a refusal, or a value that did not stay; what was written until then stays.
    """
    with ServoTalk(port) as talk:
        for one in plans:
            if one.needed:
                _carry_out(talk, one, tell)


def _carry_out(talk: ServoTalk, one: ServoPlan, tell: Callable[[str], None]) -> None:
    talk.open(one.servo.baud)
    servo_id = one.servo.servo_id
    # EEPROM is locked while torque is on; a watchdog that let go refuses goals until it is cleared.
    talk.write(servo_id, dxl.TORQUE_ENABLE, 0)
    talk.write(servo_id, dxl.BUS_WATCHDOG, 0)
    for setting in one.writes:
        register = setting.register
        tell(f"servo {servo_id}: {register} {setting.shown(setting.found)} -> {setting.shown(setting.wanted)}")
        if register == bus.ID:
            talk.write(servo_id, register, setting.wanted, read_back=False)
            _expect(talk, setting.wanted, f"id {setting.wanted}", f"id {servo_id}")
            servo_id = setting.wanted
        elif register == bus.BAUD:
            talk.write(servo_id, register, setting.wanted, read_back=False)
            talk.open(bus.BAUDS[setting.wanted])
            _expect(talk, servo_id, f"{baud_text(setting.wanted)} baud", f"{one.servo.baud} baud")
        else:
            talk.write(servo_id, register, setting.wanted)


def _expect(talk: ServoTalk, servo_id: int, now: str, before: str) -> None:
    if not talk.answers(servo_id):
        raise DeviceError(
            f"servo {servo_id}: does not answer with its new {now} (it had {before}); run companion arm scan: it is found at "
            "either, and setup goes on from there"
        )
