"""A person at the monitor's page, over everything that is real: browser, monitor, mosquitto, and a flight in the simulated world."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import sync_playwright

from companion.model.exit_codes import EXIT_ABORTED
from tests.broker import loopback_broker
from tests.browser import ARGUMENTS, chromium
from tests.support import CATCH, DEADLINE_S, Sandbox, read_summary, sandbox_in, set_options

SLACK = "[data-figure='tether']"


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
def page_at(address: str) -> Iterator[Any]:
    """The page in a browser; what the browser complains about fails the test."""
    complaints: list[str] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium(), args=list(ARGUMENTS))
        page = browser.new_page(viewport={"width": 1440, "height": 900})
        page.set_default_timeout(DEADLINE_S * 1e3)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(address)
        yield page
        browser.close()
    assert complaints == []


def until_text(page: Any, selector: str, text: str) -> None:
    page.wait_for_function(
        "([s, t]) => document.querySelector(s)?.textContent.includes(t)", arg=[selector, text], polling=50
    )


def answer(page: Any, command: str) -> str:
    """What the vehicle said to it."""
    page.wait_for_function(
        "c => !['wait', undefined].includes(document.querySelector(`#answers [data-for=${c}]`)?.dataset.state)",
        arg=command,
        polling=50,
    )
    found: str = page.inner_text(f"#answers [data-for={command}]")
    return found


@pytest.mark.alone
@pytest.mark.flight
def test_the_catch_is_watched_held_and_landed_from_the_page(tmp_path: Path) -> None:
    with (
        loopback_broker(tmp_path) as broker,
        sandbox_in(tmp_path / "sandbox") as sandbox,
        monitor(sandbox, broker.url) as address,
        page_at(address) as page,
    ):
        to_broker = set_options(**{"vehicle.ground.mqtt.url": broker.url})
        with sandbox.start("fly", CATCH, "--sitl", "--out", "out", *to_broker) as flight:
            until_text(page, "#word", "FLYING")
            first_m = float(page.inner_text(SLACK).split()[0])
            until_text(page, "#event-list", "payload caught")
            assert 0.0 < float(page.inner_text(SLACK).split()[0]) != first_m, "the slack on the page is not live"
            page.click("[data-command=hold]")
            assert "holding" in answer(page, "hold")
            until_text(page, "#word", "HOLDING")
            page.click("[data-command=land]")
            assert "landing" in answer(page, "land")
            until_text(page, "#word", "LANDING")
            ended = flight.end()
            until_text(page, "#word", "ENDED")
        summary = read_summary(sandbox.cwd / "out")
    assert ended.code == EXIT_ABORTED, ended
    ids = [event["id"] for event in summary["events"]]
    assert [id_ for id_ in ids if id_ in ("takeoff", "catch", "operator_hold", "operator_land", "touchdown")] == [
        "takeoff",
        "catch",
        "operator_hold",
        "operator_land",
        "touchdown",
    ]
    assert summary["recorder"]["dropped"] == 0
