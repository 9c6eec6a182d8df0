"""Ctrl-C ends a commissioning tool, whatever it waits for, and changes nothing. One simulated world for all of them."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from companion.model.exit_codes import EXIT_ABORTED
from tests.commissioning.test_mocap_wires import VEHICLE
from tests.support import CATCH, DEADLINE_S, Running, Sandbox, World, sandbox_in


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    with sandbox_in(tmp_path_factory.mktemp("world")) as around, World(around) as made:
        yield made


def wait_for_error(running: Running, text: str) -> None:
    """Until standard error has shown it: there people are reported what to do."""
    deadline_s = time.monotonic() + DEADLINE_S
    while text not in running._text("err"):
        assert running._pump(deadline_s), (text, running._text("out"), running._text("err"))


@pytest.mark.parametrize(
    ("words", "shown", "last"),
    [
        (("mocap", "check", "--seconds", 300), "watching", "companion mocap: interrupted"),
        (("mocap", "align", CATCH, "--json"), "1/4", "cancelled; nothing was changed"),
        (("latency",), "hold the vehicle up", "companion latency: interrupted"),
        (("ft", "check", "--weight", 1), "empty and untouched", "companion ft: interrupted"),
    ],
    ids=lambda value: " ".join(map(str, value[:2])) if isinstance(value, tuple) else "",
)
def test_ctrl_c_ends_it(
    sandbox: Sandbox, world: World, tmp_path: Path, words: tuple[object, ...], shown: str, last: str
) -> None:
    vehicle = VEHICLE.read_bytes()
    with sandbox.start(*words, "--vehicle", VEHICLE, *world.addresses()) as running:
        wait_for_error(running, shown)
        running.signal(signal.SIGINT)
        ended = running.end()
    assert (ended.code, ended.out) == (EXIT_ABORTED, ""), ended
    assert last in ended.err_lines[-1]
    assert VEHICLE.read_bytes() == vehicle
