"""`companion arm jog` and `companion arm friction`, from beginning to end: the arm moves, slowly and bounded."""

from __future__ import annotations

import argparse
import asyncio
import math
import sys
from collections.abc import Callable, Sequence
from typing import Any

from rich.console import Console

from companion.commissioning.arm.drive import Driven, Leader, drive
from companion.commissioning.arm.friction import Estimate, FrictionFit, fit
from companion.commissioning.arm.jog import ByKeys, ToAngle, keys_in
from companion.commissioning.arm.motion import LOAD_NM, SPEED_MAX_DEG_S, TORQUE_SHARE, Motion, Moved, walls_deg
from companion.commissioning.arm.result import finish
from companion.commissioning.arm.screen import Bars, ask, people_console, pressed, raw_keys, say
from companion.commissioning.arm.sweep import Sweeper, duration_s, legs_of
from companion.commissioning.arm.zero_tool import stand_text
from companion.config.document import ConfigError
from companion.config.vehicle import Vehicle
from companion.model.exit_codes import EXIT_ABORTED
from companion.model.types import ArmState, Vec2

SHOW_S = 0.1
_NAMES = ("joint 1", "joint 2")


def run_jog(arguments: argparse.Namespace, vehicle: Vehicle) -> int:
    """Move one joint: by keys, or to an angle.

    Raises:
        DeviceError: the arm does not open.
        ConfigError: the options do not fit each other or the walls.
    """
    people = people_console(arguments.json)
    if (arguments.to is None) != (arguments.joint is None):
        raise ConfigError(
            ["companion arm jog: --joint N and --to DEG belong together; without both, keys move the arm"]
        )
    if arguments.to is None:
        if sys.stdin is None or not sys.stdin.isatty():
            raise ConfigError(
                ["companion arm jog: no terminal to take keys from; --joint N --to DEG --yes moves without keys"]
            )
        if not _may_move(arguments, people, vehicle, "keys move the arm"):
            return EXIT_ABORTED
        return _by_keys(arguments, people, vehicle)
    joint: int = arguments.joint
    low, high = walls_deg(vehicle.arm, joint)
    if not math.isfinite(arguments.to) or not low <= arguments.to <= high:
        raise ConfigError(
            [
                f"companion arm jog: --to {arguments.to:g}: expected {low:g} to {high:g} deg, joint {joint + 1}'s walls less a margin"
            ]
        )
    if not _may_move(arguments, people, vehicle, f"joint {joint + 1} moves to {arguments.to:g} deg"):
        return EXIT_ABORTED
    leader = ToAngle(joint, arguments.to)
    with Bars(people, _NAMES) as bars:
        driven = asyncio.run(drive(vehicle, _Shown(leader, vehicle, bars, lambda: "")))
    return _end_jog(arguments, people, driven)


def _by_keys(arguments: argparse.Namespace, people: Console, vehicle: Vehicle) -> int:
    leader = ByKeys()
    say(people, "  1, 2: which joint; arrows or + and -: move it while held; any other key: stop; q: end", "bold")
    with raw_keys() as keys, Bars(people, _NAMES) as bars:
        shown = _Shown(leader, vehicle, bars, lambda: leader.told or f"keys move joint {leader.joint + 1}")
        shown.keys = lambda: leader.press(keys_in(pressed(keys)))
        driven = asyncio.run(drive(vehicle, shown))
    return _end_jog(arguments, people, driven)


def _end_jog(arguments: argparse.Namespace, people: Console, driven: Driven) -> int:
    first, second = driven.angle_deg
    if driven.stop:
        say(people, f"stopped: {driven.stop}", "bold red")
    most = max(driven.load_max_nm)
    say(people, f"the arm is limp, at ({first:.1f}, {second:.1f}) deg; at most {most:.2f} N m beside gravity")
    result = {"stopped": driven.stop, "angle_deg": [first, second], "load_max_nm": list(driven.load_max_nm)}
    return finish(arguments, people, not driven.stop, {}, result)


def run_friction(arguments: argparse.Namespace, vehicle: Vehicle) -> int:
    """Sweep, fit, propose.

    Raises:
        DeviceError: the arm does not open.
        ConfigError: the walls leave too little room.
    """
    people = people_console(arguments.json)
    leader = _Sweeps(vehicle)
    seconds = duration_s(legs_of(vehicle.arm), vehicle.safety.fold_arm_deg)
    if not _may_move(arguments, people, vehicle, f"both joints sweep slowly for about {seconds:.0f} s, about hanging"):
        return EXIT_ABORTED
    with Bars(people, _NAMES) as bars:
        driven = asyncio.run(drive(vehicle, _Shown(leader, vehicle, bars, leader.told)))
    if driven.stop:
        say(people, f"stopped: {driven.stop}", "bold red")
        return finish(arguments, people, False, {}, {"stopped": driven.stop, "joints": [None, None], "notes": []})
    found = fit(leader.sweeper.samples, vehicle)
    _show_fit(people, vehicle, found)
    told = found.torque_per_amp_nm_a is not None and found.joint_friction_nm is not None
    return finish(arguments, people, told, found.changes(vehicle), _fit_json(found))


class _Sweeps:
    """The sweeper as a leader."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self.sweeper = Sweeper((), vehicle.arm.torque_per_amp_nm_a)

    def begin(self, state: ArmState) -> Sequence[Vec2]:
        """Where it goes, from where it is."""
        legs = legs_of(self._vehicle.arm)
        self.sweeper = Sweeper(legs, self._vehicle.arm.torque_per_amp_nm_a)
        at, poses = list(state.angle_rad), [state.angle_rad]
        for leg in legs:
            at[leg.joint] = math.radians(leg.goal_deg)
            poses.append((at[0], at[1]))
        return poses

    def update(self, motion: Motion, moved: Moved | None, state: ArmState) -> bool:
        """True: all legs are behind."""
        self.sweeper.update(motion, moved, state)
        return self.sweeper.done

    def told(self) -> str:
        """Where it is."""
        sweeper = self.sweeper
        if not 0 <= sweeper.leg < len(sweeper.legs):
            return ""
        leg = sweeper.legs[sweeper.leg]
        what = f"at {leg.speed_deg_s:g} deg/s" if leg.counts else "on the way"
        return f"{sweeper.leg + 1}/{len(sweeper.legs)}  joint {leg.joint + 1} to {leg.goal_deg:.0f} deg, {what}"


class _Shown:
    """A leader whose motion is shown."""

    def __init__(self, leader: Leader, vehicle: Vehicle, bars: Bars, told: Callable[[], str]) -> None:
        self._leader = leader
        self._walls = [joint.angle_deg for joint in vehicle.arm.joints]
        self._bars = bars
        self._told = told
        self._due_s = -math.inf
        self.keys: Callable[[], None] = lambda: None

    def begin(self, state: ArmState) -> Sequence[Vec2]:
        """The leader's."""
        return self._leader.begin(state)

    def update(self, motion: Motion, moved: Moved | None, state: ArmState) -> bool:
        """The leader's; ten times a second it is shown."""
        self.keys()
        done = self._leader.update(motion, moved, state)
        if moved is not None and state.stamp_s >= self._due_s:
            self._due_s = state.stamp_s + SHOW_S
            degrees = [math.degrees(angle) for angle in state.angle_rad]
            shares = [(deg - low) / (high - low) for deg, (low, high) in zip(degrees, self._walls, strict=True)]
            seen = [
                f"{deg:7.1f} deg  {load:+.2f} N m beside gravity  {hot:.0f} degC"
                for deg, load, hot in zip(degrees, moved.load_nm, state.temperature_c, strict=True)
            ]
            self._bars.show(shares, seen)
            self._bars.say(self._told())
        return done


def _may_move(arguments: argparse.Namespace, people: Console, vehicle: Vehicle, what: str) -> bool:
    """Say what will happen; ask unless told not to."""
    say(people, f"{arguments.part}: {what}", "bold")
    say(people, f"  propellers off; {stand_text(vehicle)}")
    bounds = f"at most {SPEED_MAX_DEG_S:g} deg/s and {100 * TORQUE_SHARE:.0f} % of the torque"
    say(people, f"  {bounds}; it stops at {LOAD_NM:g} N m that gravity does not explain, at Ctrl-C at once")
    say(people, "  at the end, however it comes, the arm goes limp: keep hands off its way down, and nothing below it")
    if arguments.yes:
        return True
    answer = ask(people, "may the arm move now?")
    if answer is None:
        raise ConfigError([f"companion arm {arguments.part}: nobody can be asked whether the arm may move; add --yes"])
    return answer


def _show_fit(people: Console, vehicle: Vehicle, found: FrictionFit) -> None:
    for index, one in enumerate(found.joints):
        if one is None:
            continue
        say(people, f"joint {index + 1}, from {one.bins} means over {one.gravity_span_nm:.2f} N m of gravity:")
        say(people, f"  torque constant   {_estimate(one.torque_per_amp_nm_a, 3)} N m/A")
        say(people, f"  dry friction      {_estimate(one.dry_nm, 4)} N m")
        say(people, f"  viscous friction  {_estimate(one.viscous_nms, 4)} N m s/rad")
        say(people, f"  turned by         {_estimate(one.off_deg, 2)} deg")
    arm = vehicle.arm
    for name, estimate, have, unit in (
        ("torque_per_amp_nm_a", found.torque_per_amp_nm_a, arm.torque_per_amp_nm_a, "N m/A"),
        ("joint_friction_nm", found.joint_friction_nm, arm.joint_friction_nm, "N m"),
    ):
        read = "the data cannot tell" if estimate is None else f"{_estimate(estimate, 3)} {unit}"
        say(people, f"{name}: {read}; the vehicle file says {have:g}", "bold")
    for note in found.notes:
        say(people, note, "yellow")


def _estimate(one: Estimate, digits: int) -> str:
    return f"{one.value:.{digits}f} ± {one.error:.{digits}f}"


def _fit_json(found: FrictionFit) -> dict[str, Any]:
    constant, friction = found.torque_per_amp_nm_a, found.joint_friction_nm
    return {
        "stopped": "",
        "torque_per_amp_nm_a": None if constant is None else constant.as_json(),
        "joint_friction_nm": None if friction is None else friction.as_json(),
        "joints": [None if one is None else one.as_json() for one in found.joints],
        "notes": list(found.notes),
    }
