"""Replay of logs on the page, in a real browser; once with the real monitor and the log of a flight."""

from __future__ import annotations

import re
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from companion.analysis.log import FlightLog
from companion.ground.protocol.messages import Presence, Stream
from companion.model.codec import to_jsonable
from companion.sitl_config.loader import load_sitl
from tests.analysis.recorded import record
from tests.analysis.synthetic_flight import sent_at
from tests.ground.monitor_stub import Message, MonitorStub, catch_flight, flown, hello, preflight, state
from tests.ground.page_browser import Page, watching
from tests.support import CATCH, free_port, sandbox_in

pytestmark = pytest.mark.xdist_group("browser")


def log_of(streams: tuple[Stream, ...] | None = None) -> Message:
    """Return what the monitor makes of a log."""
    flight = flown()
    ended = state(Presence.ENDED, outcome="completed", commands=False)
    return {
        "state": to_jsonable(ended),
        "scene": to_jsonable(flight.scene),
        "preflight": to_jsonable(preflight()),
        "events": to_jsonable(flight.events),
        "streams": [to_jsonable(stream) for stream in streams or flight.streams],
    }


def replays(stub: MonitorStub) -> None:
    """Make a stub offer two logs."""
    stub.greeting = [hello(can_command=False, replay=True, logs=["first.mcap", "second.mcap"], why_not="a log")]
    stub.replay = [log_of(), log_of(tuple(replace(s, phase="second log") for s in flown().streams))]


@pytest.fixture
def stub() -> Iterator[MonitorStub]:
    """A stub for a test with its own log, or none."""
    with MonitorStub() as stub:
        replays(stub)
        yield stub


@pytest.fixture(scope="module")
def opened_log(browser: Any) -> Iterator[tuple[Page, MonitorStub]]:
    """One page for all tests that play the log."""
    with MonitorStub() as stub:
        replays(stub)
        with watching(browser, stub, settle=loaded) as page:
            yield page, stub


@pytest.fixture
def page(opened_log: tuple[Page, MonitorStub]) -> Page:
    """The page at the beginning of the loaded log, not playing."""
    page = opened_log[0]
    if page.tab.get_attribute("#replay-play", "aria-label") == "Pause":
        page.tab.click("#replay-play")
    page.tab.select_option("#replay-speed", "1")
    page.tab.evaluate("document.activeElement.blur()")
    page.tab.keyboard.press("Home")
    assert (page.text("#word"), shown_s(page), page.text("#phase")) == ("GROUND", 0.0, flown().streams[0].phase)
    return page


def loaded(page: Page) -> None:
    """Wait until the log is loaded."""
    page.until("() => document.querySelectorAll('#replay-marks span').length === 3")
    page.until("() => document.getElementById('notice').hidden")


def scrub(page: Page, t_s: float) -> None:
    page.tab.evaluate(
        "t => { const s = document.getElementById('replay-time'); s.value = t; s.dispatchEvent(new Event('input')); }",
        t_s,
    )


def shown_s(page: Page) -> float:
    """Return the displayed time in the log."""
    match = re.match(r"(\d+):([\d.]+) / ", page.text("#replay-now"))
    assert match is not None
    return 60.0 * int(match[1]) + float(match[2])


def test_scrubbing_shows_that_instant(page: Page) -> None:
    for mission_t_s in (15.0, 2.0, 8.5):
        stream = flown().at(mission_t_s)
        scrub(page, stream.t_s + 0.01)
        assert stream.tether is not None and stream.position_world_m is not None
        assert page.figure("tether") == f"{stream.tether.slack_m:.2f}"
        assert page.figure("height") == f"{stream.position_world_m[2]:.2f}"
        assert page.text("#phase") == stream.phase
    assert page.text("#word") == "FLYING" and not page.tab.is_visible("#stale")


def test_events_are_those_up_to_the_instant(page: Page) -> None:
    catch = next(line for line in flown().events.lines if line.id == "catch")
    scrub(page, catch.t_s - 0.1)
    assert page.tab.locator("[data-event='catch']:not(#replay-marks *)").count() == 0
    scrub(page, catch.t_s + 0.1)
    assert page.tab.locator("#event-list [data-event='catch']").count() == 1
    scrub(page, catch.t_s - 0.1)
    assert page.tab.locator("#event-list [data-event='catch']").count() == 0


def test_keys_step_and_play_at_the_chosen_speed(page: Page) -> None:
    for key, expected_s in (("ArrowRight", 1.0), ("ArrowRight", 2.0), ("ArrowLeft", 1.0), ("Shift+ArrowLeft", 0.95)):
        page.tab.keyboard.press(key)
        assert shown_s(page) == pytest.approx(expected_s, abs=0.051)
    page.tab.keyboard.press("ArrowUp")
    assert page.tab.input_value("#replay-speed") == "2"
    page.tab.select_option("#replay-speed", "8")
    page.tab.evaluate("document.activeElement.blur()")
    page.tab.keyboard.press("Space")
    page.run(1.0)
    page.tab.keyboard.press("Space")
    after_s = shown_s(page)
    assert after_s == pytest.approx(0.95 + 8.0, abs=0.5)
    page.run(0.5)
    assert shown_s(page) == after_s


def test_playing_ends_with_the_log(page: Page) -> None:
    page.tab.keyboard.press("End")
    page.tab.keyboard.press("ArrowLeft")
    page.tab.click("#replay-play")
    page.run(1.5)
    assert page.tab.get_attribute("#replay-play", "aria-label") == "Play"
    assert (page.text("#word"), page.text("#why")) == ("ENDED", "completed")


def test_another_log_can_be_picked(page: Page) -> None:
    page.tab.select_option("#replay-log", "1")
    page.until_text("#phase", "second log")
    loaded(page)
    page.tab.select_option("#replay-log", "0")
    page.until("() => document.getElementById('phase').textContent !== 'second log'")
    loaded(page)


def test_nothing_can_be_commanded(opened_log: tuple[Page, MonitorStub], page: Page) -> None:
    assert not page.tab.is_visible("#commands")
    page.tab.keyboard.press("Shift+H")
    page.tab.keyboard.press("End")
    assert page.text("#word") == "ENDED" and opened_log[1].received("command") == []


def test_a_log_that_is_not_to_be_had_is_one_line(browser: Any, stub: MonitorStub) -> None:
    stub.replay = []
    with watching(browser, stub, may="Failed to load resource", settle=lambda page: None) as page:
        page.until_text("#notice", "first.mcap cannot be loaded: the monitor answers")


def test_a_long_log_loads_in_pieces(browser: Any, stub: MonitorStub) -> None:
    """The page updates between the pieces and shows the progress."""
    streams = flown().streams
    count = 6_000
    times = (streams[0].t_s + 0.05 * k for k in range(count))
    stub.replay = [log_of(tuple(replace(streams[k * len(streams) // count], t_s=t) for k, t in enumerate(times)))]
    watch = """
        window.percents = new Set();
        new MutationObserver(() => {
          const found = document.getElementById("notice")?.textContent.match(/: (\\d+) %/);
          if (found) percents.add(found[1]);
        }).observe(document, { subtree: true, childList: true, characterData: true });
    """
    with watching(browser, stub, settle=loaded, script=watch) as page:
        assert page.tab.evaluate("percents.size") >= 10
        assert page.tab.inner_text("#replay-now") == "0:00.0 / 5:00.0"
        page.tab.keyboard.press("End")
        assert shown_s(page) == pytest.approx(0.05 * (count - 1), abs=0.1)


def test_the_real_monitor_plays_the_log_of_a_flight(browser: Any, tmp_path: Path) -> None:
    result = catch_flight()
    sent = tuple(sent_at(i.tick, i.t_s) for i in result.inputs)
    metadata = {"config": {"json": load_sitl(CATCH).flight.model_dump_json()}}
    log = FlightLog(
        path=tmp_path,
        inputs=tuple(result.inputs),
        outputs=tuple(result.outputs),
        sent=sent,
        metadata=metadata,
        closed=True,
    )
    path = record(log, tmp_path / "flight.mcap")
    url = f"http://127.0.0.1:{(port := free_port())}/"
    with sandbox_in(tmp_path / "sandbox") as sandbox, sandbox.start("monitor", path, "--port", port) as monitor:
        monitor.wait_for(url)
        with watching(browser, url, settle=loaded) as page:
            scrub(page, flown().at(8.5).t_s + 0.01)
            assert page.figure("height") == "1.00" and page.text("#word") == "FLYING"
            assert page.tab.locator("#event-list [data-event='catch']").count() == 1
        monitor.signal(signal.SIGINT)
        assert monitor.end().code == 0
