"""What the terminal of `companion fly` shows of a flight's messages, where standard output is no terminal."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console

from companion.flight.control_loop import status_of
from companion.model.launcher_messages import AnyMessage, FlightEvent, Started
from companion.model.outputs import Outputs
from companion.runtime.console import FlightDisplay, console_on, print_result
from companion.runtime.realtime import Realtime
from companion.sitl_config.loader import load_sitl
from sitl.fast.loop import FastFlight
from tests.analysis.synthetic_flight import sent_at
from tests.support import SHORT_CATCH


def shown(*messages: AnyMessage) -> list[str]:
    """Lines below the title."""
    out = io.StringIO()
    with FlightDisplay(Console(file=out, width=60), "a flight") as display:
        for message in messages:
            display.on_message(message)
    return out.getvalue().splitlines()[1:]


def test_what_the_flight_got_of_the_system_is_one_line() -> None:
    got = str(Realtime(50, (2, 3), False, ("memory not locked (RLIMIT_MEMLOCK is 8192 kB, expected unlimited)",)))
    [line] = shown(Started(recorder_pid=1, realtime=got, simulated=False))
    assert line.split(maxsplit=2) == ["real", "time", got]


def test_what_the_system_refused_is_no_markup() -> None:
    got = "normal priority (PermissionError: [bold]no[/] permission)"
    [line] = shown(Started(recorder_pid=1, realtime=got, simulated=False))
    assert line.endswith(got)


def test_a_flight_of_one_tick_has_neither_rate_nor_lateness() -> None:
    """As of a flight that finds the vehicle in the air and leaves it to PX4 at once."""
    spread = dict.fromkeys(("p50", "p99", "max"))
    summary = {"outcome": "aborted", "controller": "adaptive", "preset": "recommended", "rms": {}} | {
        "loop": {"rate_hz": None, "ticks": 1, "missed": 0, "lateness_ms": spread}
    }
    out = io.StringIO()
    print_result(Console(file=out, width=60), summary, Path("out"), None)
    assert [line.split() for line in out.getvalue().splitlines() if line.startswith("control loop")] == [
        ["control", "loop", "1", "ticks,", "0", "missed"]
    ]


def test_the_result_names_the_event_that_ended_the_flight_on_one_line() -> None:
    """The first of the events with the most severe action, by the id under which the troubleshooting page has it."""
    events = [
        {"id": name, "action": action, "text": f"what {name} means [and more], which is longer than the line is wide"}
        for name, action in (("a", "nominal"), ("b", "warn"), ("c", "land"), ("d", "land"), ("e", "hold"))
    ]
    known = {"controller": "adaptive", "preset": "recommended", "rms": {}}

    def rows(outcome: str, count: int) -> list[str]:
        out = io.StringIO()
        folder = Path("a folder [of mine] with a long name")
        print_result(Console(file=out, width=60), known | {"outcome": outcome, "events": events[:count]}, folder, None)
        assert f"report      none; see the folder {folder}" in out.getvalue().splitlines()
        return [line for line in out.getvalue().splitlines() if line.startswith("event")]

    assert rows("aborted", 5) == [f"event       c: {events[2]['text']}"]
    assert rows("aborted", 2) == [f"event       b: {events[1]['text']}"]
    assert rows("aborted", 1) == rows("completed", 5) == rows("refused", 5) == []


def messages_of(tick: int, outputs: Outputs) -> list[AnyMessage]:
    """As the flight process sends them in one tick."""
    t_s, mission_t_s = outputs.t_s, outputs.mission_t_s
    events = [
        FlightEvent(
            tick=tick, t_s=t_s, mission_t_s=mission_t_s, id=e.id, severity=e.severity, action=e.action, text=e.text
        )
        for e in outputs.events
    ]
    sent = sent_at(tick, t_s)
    return [*events, status_of(outputs, sent)]


def test_every_step_of_a_flight_is_printed_once() -> None:
    result = FastFlight(load_sitl(SHORT_CATCH)).run()
    lines = shown(*(message for k, outputs in enumerate(result.outputs) for message in messages_of(k, outputs)))
    steps = [line[14:] for line in lines]
    assert len(set(steps)) == len(steps), steps
    assert [step for step in steps if "caught" not in step] == [
        "wait", "offboard", "arm", "spool up", "take-off", "catch", "hold", "land", "touchdown", "disarm", "done",
    ]  # fmt: skip


def test_a_file_is_no_terminal_whatever_force_color_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """Notebooks and CI set it: a campaign wrote tens of thousands of lines of its progress there."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert not console_on(io.StringIO()).is_terminal
