"""The ground commands a flight over everything that is real: browser, monitor, `companion command`, mosquitto, and a flight."""

from __future__ import annotations

import itertools
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from mcap.reader import make_reader
from playwright.sync_api import Page, TimeoutError, sync_playwright

from companion.analysis.log import FlightLog
from companion.model.exit_codes import EXIT_ABORTED, EXIT_LOST, EXIT_OK, EXIT_REFUSED
from companion.model.types import OperatorCommand
from tests.broker import loopback_broker
from tests.browser import ARGUMENTS, chromium
from tests.support import (
    DEADLINE_S,
    HOVER,
    SHORT_CATCH,
    Ended,
    Sandbox,
    read_summary,
    run_here,
    sandbox_in,
    set_options,
)

SLACK = "[data-figure='tether']"
TOO_OLD = " s old (limit"
"""In the refusal of a command that has waited for a core: it is given again."""
ROOM = {
    "mission.phases[0].height_m": 0.7,
    "mission.phases[0].duration_s": 2.0,
    "mission.phases[1].to_m": [0.4, 0.0, 0.7],
    "mission.phases[2].duration_s": 600.0,
}
"""High enough to hold, and time over the place after the catch for all that is commanded there, on a loaded machine: the world is never
faster than a clock.
"""


@contextmanager
def monitor(sandbox: Sandbox, broker: str) -> Iterator[str]:
    """`companion monitor`; yields the address that it prints, token and all."""
    command = [sys.executable, "-m", "companion", "monitor", "--broker", broker, "--port", "0"]
    environment = {**sandbox.environment, "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(command, cwd=sandbox.cwd, env=environment, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        for line in process.stdout:
            if found := re.search(r"http://\S+", line):
                yield found[0]
                break
        else:
            raise AssertionError("the monitor printed no address")
    finally:
        process.terminate()
        process.wait(DEADLINE_S)
        process.stdout.close()


@contextmanager
def page_at(address: str) -> Iterator[Page]:
    """The page in a browser; what the browser complains about fails the test."""
    complaints: list[str] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium(), args=list(ARGUMENTS))
        page = browser.new_page(viewport={"width": 480, "height": 480}, reduced_motion="reduce")
        page.set_default_timeout(DEADLINE_S * 1e3)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(address)
        yield page
        browser.close()
    assert complaints == []


def until_text(page: Page, selector: str, text: str) -> None:
    page.wait_for_function(
        "([s, t]) => document.querySelector(s)?.textContent.includes(t)", arg=[selector, text], polling=50
    )


def given(page: Page, command: Callable[[], object], word: str) -> None:
    """Give a command until the page shows the word: on a busy computer an answer, or the command itself, may be lost or late."""
    while page.text_content("#word") != word:
        assert page.text_content("#word") != "ENDED"
        command()
        with suppress(TimeoutError):
            page.wait_for_function(
                "w => document.querySelector('#word').textContent === w", arg=word, timeout=30e3, polling=50
            )


def commanded(name: str, url: str) -> Ended:
    """`companion command NAME`, in a thread: the browser's driver has an event loop in this one."""
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(run_here, "command", name, "--broker", url).result()


def answered(name: str, url: str) -> Ended:
    """Give a command until the vehicle answers that it does it, or why not."""
    while True:
        ended = commanded(name, url)
        if ended.code != EXIT_LOST and TOO_OLD not in ended.err:
            return ended


def test_the_catch_is_started_watched_held_let_go_on_and_landed_from_the_ground(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (
        loopback_broker(tmp_path) as broker,
        sandbox_in(tmp_path / "sandbox") as sandbox,
        monitor(sandbox, broker.url) as address,
        page_at(address) as page,
    ):
        monkeypatch.setenv("XDG_CONFIG_HOME", str(sandbox.config))  # the key to command with
        options = set_options(**{"vehicle.ground.mqtt.url": broker.url, **ROOM})
        words = ("fly", SHORT_CATCH, "--sitl", "--speed", "1", "--wait-for-start", "--out", "out")
        with sandbox.start(*words, *options) as flight:
            flight.wait_for("take off with: companion command start")
            refused = answered("resume", broker.url)
            assert refused.code == EXIT_REFUSED and "resume refused: on the ground" in refused.err, refused
            given(page, lambda: commanded("start", broker.url), "FLYING")
            until_text(page, "#event-list", "payload caught")
            given(page, lambda: page.click("[data-command=hold]"), "HOLDING")
            in_the_air_m = float(page.inner_text(SLACK).split()[0])
            given(page, lambda: commanded("resume", broker.url), "FLYING")
            given(page, lambda: page.click("[data-command=land]"), "LANDING")
            ended = flight.end()
            until_text(page, "#word", "ENDED")
            on_the_ground_m = float(page.inner_text(SLACK).split()[0])
            assert abs(in_the_air_m - on_the_ground_m) > 0.1, "the slack on the page is not live"
    assert ended.code == EXIT_ABORTED, ended
    assert ended.err == ""
    for line in (
        f"connected to {broker.url}",
        "commanded start: taking off",
        "commanded resume: resume refused: on the ground",
        "commanded resume: continuing",
        "commanded land: landing",
    ):
        assert line in ended.out, (line, ended.out)
    out = sandbox.cwd / "out"
    summary = read_summary(out)
    wanted = ["operator_start", "takeoff", "catch", "operator_hold", "operator_resume", "operator_land", "touchdown"]
    assert [event["id"] for event in summary["events"] if event["id"] in wanted] == wanted
    assert 2.5 < summary["catch_t_s"] < 4.5 and summary["rms"]["post"]["e_p_m"] < 0.06
    assert summary["recorder"]["dropped"] == 0
    log = FlightLog.read(out / "flight.mcap")
    asked = [inputs.command for inputs in log.inputs if inputs.command is not OperatorCommand.NONE]
    assert [command for command, _ in itertools.groupby(asked)] == [
        *(OperatorCommand.RESUME, OperatorCommand.START, OperatorCommand.HOLD, OperatorCommand.RESUME),
        OperatorCommand.LAND,
    ]
    with (out / "flight.mcap").open("rb") as file:
        lines = [m.data.decode(errors="replace") for _, _, m in make_reader(file).iter_messages(topics=["/log"])]
    assert any(re.search(r"hold of \S+: holding", line) for line in lines)
    replayed = run_here("replay", out / "flight.mcap")
    assert replayed.code == EXIT_OK, replayed.out + replayed.err


def test_without_its_recorder_it_still_stands_down_on_ctrl_c(tmp_path: Path) -> None:
    """Waiting for its start, the recorder is killed: no commands any more, told once; Ctrl-C ends it as ever."""
    with loopback_broker(tmp_path) as broker, sandbox_in(tmp_path / "sandbox") as sandbox:
        options = set_options(**{"vehicle.ground.mqtt.url": broker.url})
        with sandbox.start("fly", HOVER, "--sitl", "--wait-for-start", "--out", "out", *options) as flying:
            flying.wait_for("take off with: companion command start")
            flying.wait_for("connected to")
            recorder = sandbox.pid_of("companion.recorder.main")
            os.kill(recorder, signal.SIGKILL)
            flying.wait_for("no telemetry, no commands")
            flying.signal(signal.SIGINT)
            ended = flying.end()
        sandbox.assert_nobody_left()
    assert ended.code == EXIT_ABORTED, ended.out + ended.err
    assert ended.out.count("no telemetry, no commands") == 1
