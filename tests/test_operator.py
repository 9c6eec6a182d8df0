"""What people ask for, tick by tick: the launcher's landing stays, commands over the air have one tick each, the gravest first."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator

import pytest

from companion import status
from companion.operator import WAITING_MAX, GivenUp, Operator
from companion.types import GroundCommand, OperatorCommand
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
    return [GroundCommand(command, "anna", f"{number:032x}") for number, command in enumerate(commands)]


def given(operator: Operator, ticks: int) -> list[OperatorCommand]:
    return [operator.next()[0] for _ in range(ticks)]


def test_each_command_has_one_tick_and_the_gravest_comes_first(
    launcher_and_operator: tuple[socket.socket, Operator],
) -> None:
    _, operator = launcher_and_operator
    assert operator.ask(asked(START, RESUME, HOLD, LAND, ABORT)) == []
    assert given(operator, 7) == [ABORT, LAND, HOLD, RESUME, START, NONE, NONE]


def test_the_same_command_again_begins_again(launcher_and_operator: tuple[socket.socket, Operator]) -> None:
    _, operator = launcher_and_operator
    operator.ask(asked(HOLD, HOLD))
    assert given(operator, 2) == [HOLD, NONE]
    operator.ask(asked(ABORT))
    assert given(operator, 4) == [ABORT, HOLD, NONE, NONE]


def test_each_is_answered_by_name(launcher_and_operator: tuple[socket.socket, Operator]) -> None:
    _, operator = launcher_and_operator
    commands = asked(RESUME, HOLD)
    operator.ask(commands)
    assert [operator.next()[1] for _ in range(3)] == [commands[1], commands[0], None]


def test_of_too_many_the_mildest_are_sent_back(launcher_and_operator: tuple[socket.socket, Operator]) -> None:
    _, operator = launcher_and_operator
    too_many = operator.ask(asked(*[RESUME] * WAITING_MAX, LAND, HOLD))
    assert [back.command for back in too_many] == [RESUME, RESUME]
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
                status.send(launcher, {"type": "land"})
            async with asyncio.timeout(DEADLINE_S):
                with pytest.raises(GivenUp):
                    await operator.unless_land(never())
            operator.ask(asked(RESUME, START))
            return given(operator, 5)

    assert asyncio.run(heard()) == [LAND] * 5
    operator.ask(asked(RESUME))
    assert operator.next() == (LAND, asked(RESUME)[0])
