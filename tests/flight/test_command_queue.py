"""What people ask for, tick by tick: the launcher's landing stays, commands over the air have one tick each, the gravest first."""

from __future__ import annotations

import asyncio
import math
import socket
from collections.abc import Iterator

import msgspec
import pytest

from companion.flight.command_queue import WAITING_MAX, Operator, StartCancelled, TickCommand
from companion.model.launcher_messages import Land
from companion.model.outputs import Outputs
from companion.model.types import AutopilotRequest, GroundCommand, OperatorCommand, PhaseKind, SafetyAction
from companion.runtime import ipc
from tests.support import DEADLINE_S

NONE, HOLD, RESUME, LAND, ABORT, START = (
    OperatorCommand.NONE,
    OperatorCommand.HOLD,
    OperatorCommand.RESUME,
    OperatorCommand.LAND,
    OperatorCommand.ABORT,
    OperatorCommand.START,
)


@pytest.fixture
def launcher_and_operator() -> Iterator[tuple[socket.socket, Operator]]:
    launcher, flight = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    flight.setblocking(False)
    with launcher, flight:
        yield launcher, Operator(flight)


def asked(*commands: OperatorCommand) -> list[GroundCommand]:
    return [
        GroundCommand(command=command, operator="anna", nonce=f"{number:032x}", hold=0, t_s=0.0)
        for number, command in enumerate(commands)
    ]


def given(operator: Operator, ticks: int) -> list[OperatorCommand]:
    return [operator.next(0.0).command for _ in range(ticks)]


def test_each_command_has_one_tick_and_the_gravest_comes_first(
    launcher_and_operator: tuple[socket.socket, Operator],
) -> None:
    _, operator = launcher_and_operator
    assert operator.ask(asked(HOLD, LAND, ABORT, START, RESUME)) == []
    assert given(operator, 7) == [ABORT, LAND, HOLD, RESUME, START, NONE, NONE]


@pytest.mark.parametrize("stop", [HOLD, LAND, ABORT])
@pytest.mark.parametrize("one_batch", [True, False])
def test_a_stop_drops_every_resume_and_start_that_was_given_before_it(
    launcher_and_operator: tuple[socket.socket, Operator], stop: OperatorCommand, one_batch: bool
) -> None:
    _, operator = launcher_and_operator
    commands = asked(RESUME, START, RESUME, stop)
    dropped = (
        operator.ask(commands) if one_batch else [back for command in commands for back in operator.ask([command])]
    )
    assert sorted(back.asked.nonce for back in dropped) == [command.nonce for command in commands[:3]]
    assert {back.why for back in dropped} == {f"a {stop.value} was commanded later"}
    assert given(operator, 5) == [stop, NONE, NONE, NONE, NONE]


def in_tick(action: SafetyAction) -> Outputs:
    return Outputs(
        tick=0,
        t_s=0.0,
        mission_t_s=0.0,
        phase="hold",
        phase_kind=PhaseKind.FLIGHT,
        progress=0.0,
        request=AutopilotRequest.NONE,
        action=action,
        events=(),
        mocap_trusted=True,
        limited_by=(),
    )


def resume(hold: int) -> GroundCommand:
    return GroundCommand(command=RESUME, operator="anna", nonce="0" * 32, hold=hold, t_s=0.0)


def test_a_resume_ends_the_hold_that_it_names_and_no_other(
    launcher_and_operator: tuple[socket.socket, Operator],
) -> None:
    _, operator = launcher_and_operator
    assert operator.judged(HOLD, in_tick(SafetyAction.HOLD)) == 1
    assert operator.judged(NONE, in_tick(SafetyAction.HOLD)) == 1
    assert operator.judged(HOLD, in_tick(SafetyAction.HOLD)) == 2, "held again: who saw the first has not seen this one"
    for named, meant in ((1, "hold 1"), (0, "no hold"), (3, "hold 3")):
        operator.ask([resume(named)])
        turn = operator.next(0.0)
        assert (turn.command, turn.asked) == (NONE, resume(named))
        assert (
            turn.refused
            == f"resume refused: it names {meant}, but hold 2 is active; check the situation, then command it again"
        )
    operator.ask([resume(2)])
    assert operator.next(0.0) == TickCommand(RESUME, resume(2))
    assert operator.judged(RESUME, in_tick(SafetyAction.NOMINAL)) is None
    operator.ask([resume(2)])
    assert operator.next(0.0).command is NONE, "the same command again begins a tick later"
    assert operator.next(0.0) == TickCommand(RESUME, resume(2)), "nothing stands: the core says so"
    assert operator.judged(RESUME, in_tick(SafetyAction.LAND)) is None
    assert operator.judged(NONE, in_tick(SafetyAction.HOLD)) == 3


async def _turns(operator: Operator, ticks: int = 6) -> list[TickCommand]:
    turns = []
    for _ in range(ticks):
        turns.append(operator.next(0.0))
        await asyncio.sleep(0)
    return turns


@pytest.mark.parametrize("why", ["", "start refused: PX4's parameters have changed"])
def test_a_start_waits_until_px4s_parameters_are_read_again(
    launcher_and_operator: tuple[socket.socket, Operator], why: str
) -> None:
    _, operator = launcher_and_operator
    reads = []

    async def recheck() -> str:
        reads.append(operator)
        await asyncio.sleep(0)
        return why

    operator.recheck = recheck
    (start,) = asked(START)
    for _ in range(2):  # again after a refusal: they may have been set back
        operator.ask([start])
        first, *later = asyncio.run(_turns(operator))
        assert first == TickCommand(NONE, None)
        assert [turn for turn in later if turn.asked] == [
            TickCommand(NONE, start, why) if why else TickCommand(START, start)
        ]
    assert len(reads) == 2
    operator.ask([start, *asked(HOLD)])
    assert [turn.command for turn in asyncio.run(_turns(operator)) if turn.asked] == [HOLD], "no START after the HOLD"
    operator.judged(NONE, msgspec.structs.replace(in_tick(SafetyAction.NOMINAL), phase_kind=PhaseKind.FLIGHT))
    operator.ask([start])
    assert operator.next(0.0) == TickCommand(START, start), "in the air nothing is read: the core refuses it"


def test_a_start_or_resume_that_waited_too_long_is_refused_and_a_stop_is_not(
    launcher_and_operator: tuple[socket.socket, Operator],
) -> None:
    """By then the ground station has reported that there was no answer: nobody expects the rotors to start."""
    _, operator = launcher_and_operator

    async def wait_for_parameters() -> list[TickCommand]:
        async def recheck() -> str:
            await asyncio.sleep(60.0)
            return ""

        operator.recheck = recheck
        operator.ask(asked(START))
        return [operator.next(t_s) for t_s in (0.0, 2.0, 2.1)]

    *waits, late = asyncio.run(wait_for_parameters())
    assert [turn.asked for turn in waits] == [None, None]
    assert (late.command, late.asked) == (NONE, asked(START)[0])
    advice = "check the situation, then command it again"
    assert late.refused == f"start refused: it was given 2.1 s ago (limit 2.0 s); {advice}"
    operator.ask(asked(RESUME))
    assert operator.next(30.0).refused == f"resume refused: it was given 30.0 s ago (limit 2.0 s); {advice}"
    operator.ask(asked(START))
    assert (operator.next(math.nan).refused or "").startswith("start refused"), "no age is not a small one"
    for stop in (HOLD, LAND, ABORT):
        operator.ask(asked(stop))
        assert operator.next(30.0) == TickCommand(stop, asked(stop)[0])


def test_a_resume_that_comes_right_behind_a_hold_does_not_undo_it(
    launcher_and_operator: tuple[socket.socket, Operator],
) -> None:
    """It names the hold before, whatever the order in which the two of them came."""
    for commands in ([resume(1), *asked(HOLD)], [*asked(HOLD), resume(1)]):
        operator = Operator(launcher_and_operator[1]._channel)
        operator.judged(HOLD, in_tick(SafetyAction.HOLD))
        operator.ask(commands)
        for _ in range(3):
            command = operator.next(0.0).command
            assert command in (HOLD, NONE)
            operator.judged(command, in_tick(SafetyAction.HOLD))
        assert operator.hold == 2


def test_the_same_command_again_begins_again(launcher_and_operator: tuple[socket.socket, Operator]) -> None:
    _, operator = launcher_and_operator
    operator.ask(asked(HOLD, HOLD))
    assert given(operator, 2) == [HOLD, NONE]
    operator.ask(asked(ABORT))
    assert given(operator, 4) == [ABORT, HOLD, NONE, NONE]


def test_each_is_answered_by_name(launcher_and_operator: tuple[socket.socket, Operator]) -> None:
    _, operator = launcher_and_operator
    commands = asked(LAND, HOLD, START)
    operator.ask(commands)
    assert [operator.next(0.0).asked for _ in range(4)] == [*commands, None]


def test_of_too_many_the_mildest_are_dropped(launcher_and_operator: tuple[socket.socket, Operator]) -> None:
    _, operator = launcher_and_operator
    too_many = operator.ask(asked(LAND, HOLD, *[RESUME] * WAITING_MAX))
    assert [back.asked.command for back in too_many] == [RESUME, RESUME]
    assert {back.why for back in too_many} == {"too many commands at once"}
    assert given(operator, 2) == [LAND, HOLD]


@pytest.mark.parametrize("gone", [False, True], ids=["asks to land", "is gone"])
def test_the_launchers_landing_stays_and_commands_are_still_answered(
    launcher_and_operator: tuple[socket.socket, Operator], gone: bool
) -> None:
    launcher, operator = launcher_and_operator

    async def never() -> None:
        await asyncio.Event().wait()

    async def heard() -> list[OperatorCommand]:
        with operator.attention():
            if gone:
                launcher.close()
            else:
                ipc.send(launcher, Land())
            async with asyncio.timeout(DEADLINE_S):
                with pytest.raises(StartCancelled):
                    await operator.unless_land(never())
            operator.ask(asked(RESUME, START))
            return given(operator, 5)

    assert asyncio.run(heard()) == [LAND] * 5
    operator.ask(asked(RESUME))
    assert operator.next(0.0) == TickCommand(LAND, asked(RESUME)[0], "resume refused: a landing was commanded before")
