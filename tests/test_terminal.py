"""What the terminal of `companion fly` shows of a flight's messages, where standard output is no terminal."""

from __future__ import annotations

import io

from rich.console import Console

from companion.realtime import Realtime
from companion.terminal import FlightDisplay


def shown(*messages: dict[str, object]) -> list[str]:
    """Lines below the title."""
    out = io.StringIO()
    with FlightDisplay(Console(file=out, width=60), "a flight") as display:
        for message in messages:
            display.on_message(message)
    return out.getvalue().splitlines()[1:]


def test_what_the_flight_got_of_the_system_is_one_line() -> None:
    got = str(Realtime(50, (2, 3), False, ("memory not locked (RLIMIT_MEMLOCK is 8192 kB, expected unlimited)",)))
    [line] = shown({"type": "started", "recorder_pid": 1, "realtime": got})
    assert line.split(maxsplit=2) == ["real", "time", got]


def test_what_the_system_refused_is_no_markup() -> None:
    got = "normal priority (PermissionError: [bold]no[/] permission)"
    [line] = shown({"type": "started", "recorder_pid": 1, "realtime": got})
    assert line.endswith(got)
