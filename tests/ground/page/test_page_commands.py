"""The command buttons in a real browser: a press sends one command, and its result is displayed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from msgspec.structs import replace

from companion.ground.protocol.messages import Presence
from tests.ground.monitor_stub import NAME, Message, MonitorStub, ack, flown, relayed, retained, state
from tests.ground.page_browser import Page, playing

pytestmark = pytest.mark.xdist_group("browser")

NONCE = "0123456789abcdef" * 2
CHOOSE = """(name) => {
  const select = document.getElementById("vehicle-select");
  select.value = name;
  select.dispatchEvent(new Event("change"));
}"""
"""Selects another vehicle while the pressed button keeps the focus."""
NO_ANSWER = "no answer from the vehicle within 1.5 s: use Ctrl-C or the pilot's switch"


@pytest.fixture
def page(page: Page) -> Page:
    """The page during a flight."""
    page.show(relayed(flown().at(8.5)))
    return page


def sent(command: str, nonce: str = NONCE) -> Message:
    return {"kind": "sent", "vehicle": NAME, "command": command, "nonce": nonce}


def refused(command: str, text: str) -> Message:
    return {"kind": "refused", "vehicle": NAME, "command": command, "text": text}


def answer(page: Page, command: str) -> tuple[str, str]:
    output = page.tab.locator(f"#answers [data-for='{command}']")
    return output.get_attribute("data-state"), output.inner_text()


def asked(stub: MonitorStub, count: int) -> list[str]:
    """Return the names of the first `count` commands; there must be no more."""
    heard = stub.wait_received("command", count)
    assert all(message["vehicle"] == NAME for message in heard)
    return [message["command"] for message in heard]


def test_hold_then_land_arrive_and_their_answers_show(stub: MonitorStub, page: Page) -> None:
    page.press("hold")
    assert asked(stub, 1) == ["hold"]
    assert answer(page, "hold") == ("wait", "sending …")
    page.show(sent("hold"))
    assert answer(page, "hold") == ("wait", "sent, waiting for the vehicle …")
    page.show(relayed(ack("hold", NONCE, "holding at (1.00, 0.00, 1.00) m")))
    assert answer(page, "hold") == ("done", "✓ holding at (1.00, 0.00, 1.00) m")
    page.press("land")
    assert asked(stub, 2) == ["hold", "land"]
    page.show(sent("land", "b" * 32), relayed(ack("land", "b" * 32, "landing")))
    assert answer(page, "land") == ("done", "✓ landing")
    assert answer(page, "hold")[0] == "done"


def test_refusals_missing_answers_and_others_commands_are_shown(page: Page) -> None:
    page.press("abort")
    page.show(sent("abort"), relayed(ack("abort", NONCE, "nothing to abort: on the ground", accepted=False)))
    assert answer(page, "abort") == ("no", "✗ nothing to abort: on the ground")
    page.press("land")
    page.show(sent("land"), refused("land", NO_ANSWER))
    assert answer(page, "land") == ("no", NO_ANSWER)
    page.show(sent("land", "c" * 32))
    assert answer(page, "land")[0] == "no" and "sent again (2)" in answer(page, "land")[1]
    page.show(relayed(ack("land", NONCE, "landing")))
    assert answer(page, "land") == ("done", "✓ landing")
    page.press("hold")
    page.run(2.4)
    assert answer(page, "hold")[0] == "wait"
    page.run(0.3)
    assert answer(page, "hold")[0] == "no" and "no answer from the monitor" in answer(page, "hold")[1]
    page.show(relayed(ack("hold", "d" * 32, "holding", operator="bert")))
    assert answer(page, "hold") == ("done", "✓ bert: holding")


def test_a_double_click_sends_one_command(stub: MonitorStub, page: Page) -> None:
    page.tab.dblclick("[data-command='hold']")
    page.run(0.29)
    page.press("hold")
    page.press("land")
    page.run(0.02)
    page.press("hold")
    assert asked(stub, 3) == ["hold", "land", "hold"]


@pytest.mark.parametrize(
    "lie",
    [state(Presence.ENDED, outcome="completed"), state(Presence.FLYING, commands=False, text="hears nothing")],
    ids=["ended", "hears no commands"],
)
def test_a_state_that_the_stream_contradicts_does_not_prevent_landing(stub: MonitorStub, page: Page, lie: Any) -> None:
    """The stream is proven, the state is not."""
    page.show(relayed(replace(flown().at(8.55), proofs=("0" * 32,))), relayed(lie))
    assert page.enabled() == {"hold", "land", "abort"}
    page.press("land")
    assert asked(stub, 1) == ["land"]


def test_safety_does_not_wait_for_fresh_data(stub: MonitorStub, page: Page) -> None:
    page.run(60.0)
    assert page.body("stale") == "true"
    for command in ("hold", "land", "abort"):
        page.press(command)
    assert asked(stub, 3) == ["hold", "land", "abort"]


def test_keys_command_too(stub: MonitorStub, page: Page) -> None:
    for key in ("h", "l", "Shift+L", "Control+Shift+H", "Shift+A"):
        page.tab.keyboard.press(key)
    assert asked(stub, 2) == ["land", "abort"]
    page.tab.focus("[data-command='hold']")
    page.tab.keyboard.press("Enter")
    assert asked(stub, 3)[2] == "hold"


def test_start_needs_a_vehicle_that_waits_and_a_long_press(stub: MonitorStub, page: Page) -> None:
    assert "start" not in page.enabled() and "only while waiting" in page.text("[data-command='start']")
    news = playing(flown().streams[0], waits_for_start=True)
    page.show(news())
    assert "start" in page.enabled() and "resume" not in page.enabled()
    _hold_start(page, 0.7, news)
    _hold_start(page, 0.9, news)
    page.press("hold")
    assert asked(stub, 2) == ["start", "hold"]


def test_resume_needs_a_hold_and_works_by_keyboard(stub: MonitorStub, page: Page) -> None:
    news = playing(flown().at(8.5), action="hold")
    page.show(news())
    assert "resume" in page.enabled()
    page.tab.focus("[data-command='resume']")
    page.tab.keyboard.down("Enter")
    for _ in range(3):
        page.run(0.3)
        page.show(news())
    page.tab.keyboard.up("Enter")
    assert asked(stub, 1) == ["resume"]
    page.run(1.0)
    assert "resume" not in page.enabled() and page.body("stale") == "true"


@pytest.mark.parametrize("change", ["another session", "another hold", "another vehicle"])
def test_a_press_is_for_what_was_shown_when_the_button_went_down(stub: MonitorStub, page: Page, change: str) -> None:
    """If vehicle, flight or hold has changed after 0.8 s, nothing is sent."""
    changes: dict[str, Message] = {"another session": {"session": "s2"}, "another hold": {"hold": 2}}
    after = changes.get(change, {})
    held = replace(flown().at(8.5), action="hold", hold=1)
    news = playing(held)
    page.show(news(), *retained("second"), {**news(), "vehicle": "second"})
    page.tab.hover("[data-command='resume']")
    page.tab.mouse.down()
    for k in range(9):
        page.run(0.1)
        said = news()
        if k >= 4:
            said = {**said, "data": {**said["data"], **after}}
        if k == 4 and change == "another vehicle":
            page.tab.evaluate(CHOOSE, "second")
            page.shown = "second"
        page.show(said, {**said, "vehicle": "second"})
        assert "resume" in page.enabled()
    page.tab.mouse.up()
    page.press("land")
    assert [message["command"] for message in stub.wait_received("command", 1)] == ["land"]


def test_a_long_press_ends_with_the_permission(stub: MonitorStub, page: Page) -> None:
    """The press begins while the vehicle waits for START, and the data becomes stale during it."""
    page.show(playing(flown().streams[0], waits_for_start=True)())
    page.tab.hover("[data-command='start']")
    page.tab.mouse.down()
    page.run(2.0)
    page.tab.mouse.up()
    page.press("land")
    assert asked(stub, 1) == ["land"]


def _hold_start(page: Page, seconds: float, news: Callable[[], Message]) -> None:
    """Hold START down while the vehicle keeps sending."""
    page.tab.hover("[data-command='start']")
    page.tab.mouse.down()
    for _ in range(round(seconds / 0.1)):
        page.run(0.1)
        page.show(news())
    page.tab.mouse.up()
