"""The page in a real browser: what the user sees. A stub replaces the monitor."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from msgspec.structs import replace

from companion.ground.protocol.messages import BarView, HealthLevel, Presence, Stream
from tests.ground.monitor_stub import (
    BROKER,
    NAME,
    Message,
    MonitorStub,
    ack,
    event,
    flown,
    hello,
    relayed,
    retained,
    state,
)
from tests.ground.page_browser import Page, events_of, playing, watching
from tests.support import wait_until

pytestmark = pytest.mark.xdist_group("browser")

SAFE = {"hold", "land", "abort"}
HOSTILE = "<img src=x onerror='window.pwned = 1'><script>window.pwned = 1</script>"


@pytest.fixture
def own_stub() -> Iterator[MonitorStub]:
    """A stub for a test that stops it, with a page of its own."""
    with MonitorStub(retained()) as stub:
        yield stub


@pytest.fixture(scope="module")
def watched(browser: Any) -> Iterator[Page]:
    """One page for all tests that only send records and look, because opening one takes seconds of CPU time."""
    with MonitorStub(retained()) as stub, watching(browser, stub) as page:
        yield page


@pytest.fixture(scope="module")
def newest() -> Callable[[Stream], Message]:
    """Records for tests that share a page: each is newer than those before."""
    number = itertools.count(1)
    return lambda stream: relayed(replace(stream, t_s=1000.0 + 100.0 * next(number)))


def in_flight(**changes: Any) -> Stream:
    """Return a record well after the catch, without problems."""
    return replace(flown().at(8.5), **changes)


def test_the_page_sends_its_token_first_and_values_are_those_of_the_newest_record(
    stub: MonitorStub, page: Page
) -> None:
    wait_until(lambda: bool(stub.received("token")), lambda: "the page sends no token")
    assert stub.received("token") == [{"kind": "token", "token": "secret"}]
    assert page.tab.evaluate("location.hash") == ""
    for mission_t_s in (1.5, 8.5, 14.0):
        stream = flown().at(mission_t_s)
        page.show(relayed(stream))
        assert stream.tether is not None and stream.position_world_m is not None and stream.e_p_m is not None
        assert page.figure("tether") == f"{stream.tether.slack_m:.2f}"
        assert page.figure("height") == f"{stream.position_world_m[2]:.2f}"
        assert page.figure("error") == f"{stream.e_p_m:.3f}"
        assert page.text("#phase") == stream.phase
        assert page.text("#light-list li:last-child .text") == stream.lights[-1].text
    page.run(0.1)
    assert page.tab.evaluate("document.getElementById('progress').value") == pytest.approx(stream.progress, abs=1e-3)


def test_pictures_change_with_the_flight(page: Page) -> None:
    """The canvases are drawn at all, and again; not what they show."""

    def pictures() -> list[str]:
        page.run(0.5)
        found: list[str] = page.tab.evaluate("[...document.querySelectorAll('canvas')].map((c) => c.toDataURL())")
        return found

    page.show(*[relayed(stream) for stream in flown().streams if stream.mission_t_s < 2.0])
    before = pictures()
    page.show(*[relayed(stream) for stream in flown().streams if 2.0 < stream.mission_t_s < 8.0])
    after = pictures()
    assert len(before) == 8 and all(one != other for one, other in zip(before, after, strict=True))


def test_stale_shows_within_half_a_second_of_the_last_message(page: Page) -> None:
    news = playing(in_flight())
    page.show(news())
    for _ in range(3):
        page.run(0.3)
        assert page.body("stale") == "false"
        page.show(news())
    page.run(0.3)
    assert (page.body("stale"), page.tab.is_visible("#stale")) == ("false", False)
    page.run(0.2)
    assert 0.4 < float(page.tab.get_attribute("#age", "data-age")) <= 0.5
    assert page.text("#stale").startswith("STALE 0.5 s") and "FLYING" in page.text("#stale")
    assert page.tab.is_visible("#edge")
    assert page.body("frame") == "bad"
    page.run(3.0)
    assert page.text("#stale").startswith("STALE 3.5 s")
    page.show(news())
    assert (page.body("stale"), page.tab.is_visible("#stale"), page.tab.is_visible("#edge")) == ("false", False, False)


@pytest.mark.parametrize("how", ["stale", "ended"])
def test_stale_figures_are_greyed_out(page: Page, how: str) -> None:
    def look() -> list[str]:
        found: list[str] = page.tab.evaluate(
            "['.tile .value', '#light-list .text', '.lamp', '#scene', '.plot canvas'].map((s) => document.querySelector(s))"
            ".map((e) => getComputedStyle(e)).map((s) => [s.color, s.backgroundColor, s.filter, s.fontStyle].join())"
        )
        return found

    page.show(relayed(in_flight()))
    alive = look()
    if how == "ended":
        page.show(relayed(state(Presence.ENDED, outcome="completed")))
        assert look() == alive, "the stream arrives: the vehicle flies, whoever has sent that it has ended"
    page.run(1.0)
    assert all(one != other for one, other in zip(alive, look(), strict=True))


def test_a_record_that_was_long_on_its_way_is_old_when_it_comes(
    watched: Page, newest: Callable[[Stream], Message]
) -> None:
    watched.show(newest(in_flight()) | {"age_s": 0.9})
    assert watched.body("stale") == "true" and float(watched.tab.get_attribute("#age", "data-age")) >= 0.9
    watched.show(newest(in_flight()) | {"age_s": 0.01})
    assert watched.body("stale") == "false"


@pytest.mark.parametrize(("simulated", "age_s"), [(False, 2.0), (True, 0.0)])
def test_a_backlog_does_not_look_alive_and_slow_simulated_time_does(page: Page, simulated: bool, age_s: float) -> None:
    """0.1 s of the vehicle's time in 2.1 s: with real time the records are two seconds late."""
    first = in_flight()
    page.show(relayed(state(simulated=simulated)), relayed(first))
    page.run(2.1)
    page.show(relayed(replace(first, t_s=first.t_s + 0.1)))
    assert page.body("stale") == str(not simulated).lower()
    assert float(page.tab.get_attribute("#age", "data-age")) == pytest.approx(age_s, abs=0.01)


def test_no_broker_is_stale_at_once(page: Page) -> None:
    page.show(relayed(in_flight()))
    page.show({**BROKER, "connected": False, "text": "no broker at mqtt://127.0.0.1:1883, trying"})
    assert page.body("frame") == "bad"
    assert page.text("#stale").startswith("NO BROKER") and "mqtt://127.0.0.1:1883, trying" in page.text("#stale")
    assert page.enabled() == SAFE


def test_an_end_is_reported_calmly(page: Page) -> None:
    page.show(relayed(in_flight()))
    for known, word, level in (
        (state(Presence.ENDED, outcome="completed"), "ENDED completed", "ok"),
        (state(Presence.ENDED, outcome="aborted", text="landed by the guardian"), "ENDED aborted: landed", "warn"),
        (state(Presence.ENDED, outcome="crashed"), "ENDED crashed", "bad"),
    ):
        page.show(relayed(known))
        page.run(1.0)
        assert f"{page.text('#word')} {page.text('#why')}".startswith(word)
        assert (page.body("level"), page.body("stale"), page.body("old")) == (level, "false", "true")
        assert (page.enabled(), page.text("#commands-why")) == (set(), "the flight is over")


def test_a_vehicle_that_is_gone_is_framed_in_red_and_can_still_be_commanded(page: Page) -> None:
    page.show(relayed(in_flight()))
    for presence in (Presence.LOST, Presence.SILENT):
        page.show(relayed(state(presence, text="the guardian may be landing it")))
        assert page.text("#stale").startswith(presence.value.upper())
        assert "the guardian may be landing it" in page.text("#stale")
        assert (page.body("frame"), page.enabled()) == ("bad", SAFE)


def test_the_last_will_of_an_older_session_does_not_hide_a_flight(page: Page) -> None:
    page.show(relayed(in_flight()), relayed(state(Presence.LOST, session="older")))
    assert (page.text("#word"), page.body("stale")) == ("FLYING", "false")


def test_the_word_says_what_it_does_and_a_figure_has_the_colour_of_its_lamp(
    watched: Page, newest: Callable[[Stream], Message]
) -> None:
    words: tuple[tuple[dict[str, Any], str, str], ...] = (
        ({}, "FLYING", "ok"),
        ({"kind": "ground", "armed": False}, "GROUND", "ok"),
        ({"action": "hold"}, "HOLDING", "warn"),
        ({"action": "retract"}, "RETURNING", "warn"),
        ({"action": "land"}, "LANDING", "warn"),
        ({"kind": "landing"}, "LANDING", "ok"),
        ({"action": "terminate"}, "TERMINATED", "bad"),
    )
    for changes, word, grave in words:
        watched.show(newest(in_flight(**changes)))
        assert (watched.text("#word"), watched.body("level")) == (word, grave)
    for tile, lamp, level in (
        ("tether", "tether", HealthLevel.BAD),
        ("error", "flight", HealthLevel.WARN),
        ("battery", "battery", HealthLevel.BAD),
        ("latency", "loop", HealthLevel.WARN),
        ("tether", "tether", HealthLevel.OK),
    ):
        lights = tuple(replace(light, light=level) if light.name == lamp else light for light in in_flight().lights)
        watched.show(newest(in_flight(lights=lights)))
        assert watched.tab.get_attribute(f".tile:has([data-figure={tile}])", "data-level") == level.value
        assert watched.body("level") == level.value
    rows = watched.tab.locator("#light-list li")
    shown = [
        (rows.nth(k).get_attribute("data-light"), rows.nth(k).locator(".text").inner_text())
        for k in range(rows.count())
    ]
    assert shown == [(light.light.value, light.text) for light in lights]


def test_a_vehicle_without_tether_and_net_is_drawn_without_them(stub: MonitorStub, shared: Page) -> None:
    absent = {"anchor_world_m": None, "tether_length_m": None, "tether_margin_m": None, "attachment_body_m": None}
    absent["net_radius_m"] = None
    stub.greeting = [hello(), BROKER, *retained(), relayed(replace(flown().scene, **absent))]
    shared.open_anew(stub)
    shared.show(relayed(in_flight(tether=None)))
    assert "no tether" in shared.text(".tile:first-child")
    assert shared.body("level") == "ok"


def test_the_catch_appears_among_the_events_and_is_read_out(page: Page) -> None:
    page.show(relayed(in_flight()))
    assert page.tab.locator("#event-list li").count() == 0
    page.show(relayed(flown().events))
    assert "payload caught" in page.text("[data-event='catch']")
    assert page.tab.locator("#event-list li").first.get_attribute("data-event") == "touchdown"
    assert "payload caught" in page.tab.locator("#announce").text_content()
    page.show(relayed(flown().events))
    assert page.tab.locator("#event-list li").count() == len(flown().events.lines)


def test_events_can_be_filtered(page: Page) -> None:
    page.tab.click("[data-filter='critical']")
    assert page.text("#event-none") == "No events yet."
    page.show(events_of(event(1, "a", severity="info"), event(2, "b")))
    assert page.text("#event-none") == "No events of this severity."
    page.show(events_of(event(1, "a", severity="info"), event(2, "b"), event(3, "c", severity="critical")))
    visible = page.tab.locator("#event-list li:visible")
    for filtered, expected in (("warning", ["critical", "warning"]), ("critical", ["critical"])):
        page.tab.click(f"[data-filter='{filtered}']")
        assert [visible.nth(k).get_attribute("data-severity") for k in range(visible.count())] == expected
    page.tab.click("[data-filter='info']")
    assert visible.count() == 3


def test_a_new_session_begins_with_nothing_of_the_old_one(page: Page) -> None:
    page.show(relayed(in_flight()), relayed(flown().events))
    assert page.tab.locator("#event-list li").count() > 0
    page.show(relayed(state(session="new")), relayed(replace(flown().at(1.0), session="new", t_s=1.0)))
    assert page.tab.locator("#event-list li").count() == 0 and page.body("stale") == "false"


def test_what_comes_from_outside_is_text(stub: MonitorStub, page: Page) -> None:
    light = replace(in_flight().lights[0], text=HOSTILE, name=HOSTILE)
    page.show(
        relayed(state(mission=HOSTILE, text=HOSTILE)),
        relayed(in_flight(phase=HOSTILE, lights=(light,), limited_by=(HOSTILE,), mode=HOSTILE)),
        events_of(event(1, HOSTILE, id_=HOSTILE, action=HOSTILE)),
        relayed(ack("hold", "f" * 32, HOSTILE, operator=HOSTILE)),
        {**BROKER, "rejected": 3, "rejected_text": HOSTILE},
    )
    page.tab.click("#control summary")
    stub.send(relayed(state(), HOSTILE))
    page.until_text("#vehicle-select", HOSTILE)
    page.run(1.0)
    assert HOSTILE in page.text("#event-list .text") and HOSTILE in page.text("#light-list .text")
    assert HOSTILE in page.text("#answers") and HOSTILE in page.text("#notice")
    assert HOSTILE in page.tab.locator("#phase").text_content()
    assert page.tab.evaluate("[document.images.length, document.scripts.length, window.pwned ?? null]") == [0, 1, None]


def test_several_vehicles(stub: MonitorStub, page: Page) -> None:
    page.show(relayed(in_flight()))
    assert not page.tab.is_visible("#vehicle-select")
    page.show(*retained("second"), relayed(in_flight(position_world_m=(0.0, 0.0, 1.77)), "second"))
    options = page.tab.locator("#vehicle-select option")
    assert [options.nth(k).text_content() for k in range(2)] == [f"{NAME} · FLYING", "second · FLYING"]
    assert page.figure("height") == "1.00"
    page.tab.select_option("#vehicle-select", "second")
    page.shown = "second"
    assert page.figure("height") == "1.77"
    page.show(relayed(state(Presence.LOST)))
    assert options.nth(0).text_content() == f"⚠ {NAME} · LOST"
    assert page.text("#word") == "FLYING" and page.text("#notice").startswith(f"{NAME}: LOST")
    page.press("hold")
    assert stub.wait_received("command", 1) == [{"kind": "command", "vehicle": "second", "command": "hold"}]


def test_both_vehicles_of_a_team_are_shown_and_commands_go_to_the_chosen_one(stub: MonitorStub, page: Page) -> None:
    """Each names the other. As long as only one does, they are shown one at a time."""
    numbers = itertools.count(1)
    other: dict[str, Any] = {"action": "hold", "hold": 1, "position_world_m": (1.0, 1.0, 1.5)}

    def scene_of_team(vehicle: str, partner: str) -> Message:
        return relayed(replace(flown().scene, partner=partner, bar_length_m=1.2), vehicle)

    def picture(**changes: Any) -> str:
        page.show(*(relayed(in_flight(t_s=1e3 + next(numbers), **changes.get(v, {})), v) for v in (NAME, "second")))
        page.run(0.1)
        found: str = page.tab.evaluate("document.getElementById('scene').toDataURL()")
        return found

    def boxes() -> list[Any]:
        return [page.tab.locator(f"[data-command='{command}']").bounding_box() for command in ("hold", "land", "start")]

    def team() -> list[list[str]]:
        read = "(b) => [b.ariaPressed, ...['.name', '.word', '.answer'].map((s) => b.querySelector(s).innerText)]"
        found: list[list[str]] = page.tab.evaluate(f"[...document.querySelectorAll('#team button')].map({read})")
        return found

    page.show(relayed(in_flight()), scene_of_team(NAME, "second"), *retained("second"))
    pictures = [picture(second=other)]
    assert not page.tab.is_visible("#team")
    before = boxes()
    page.show(scene_of_team("second", NAME))
    pictures.append(picture(second=other))
    assert team() == [["false", "second", "HOLDING", ""], ["true", NAME, "FLYING", ""]] and boxes() == before
    assert page.tab.locator("#team [data-vehicle='second'] i").count() == len(in_flight().lights)
    other["attitude_wxyz"] = (0.6, 0.0, 0.0, 0.8)
    pictures.append(picture(second=other))
    other["bar"] = BarView(position_world_m=(0.5, 0.5, 0.8), attitude_wxyz=(1.0, 0.0, 0.0, 0.0))
    pictures.append(picture(second=other))
    assert len(set(pictures)) == 4, "the other vehicle, its attitude and its bar are drawn"

    page.press("hold")
    page.tab.click("#team [data-vehicle='second']")
    page.shown = "second"
    aims = page.tab.locator("#team .aim").all_inner_texts()
    assert aims == ["commands go here", "choose"], "second is the first in the alphabet"
    assert NAME not in page.text(".command-grid") and page.text("[data-command='hold']").endswith("second")
    page.press("land")
    page.tab.keyboard.press("Shift+A")
    asked = [(message["vehicle"], message["command"]) for message in stub.wait_received("command", 3)]
    assert asked == [(NAME, "hold"), ("second", "land"), ("second", "abort")]
    page.show({"kind": "refused", "vehicle": NAME, "command": "hold", "text": "no answer"})
    page.run(1.0)
    assert team()[1] == ["false", NAME, "STALE", "hold: no answer"]


def test_without_a_connection_nothing_is_sent_and_a_restarted_monitor_is_found_again(
    browser: Any, own_stub: MonitorStub
) -> None:
    with watching(browser, own_stub, may="WebSocket connection to") as page:
        page.show(relayed(in_flight()))
        own_stub.stop()
        page.until_text("#stale", "NO CONNECTION")
        assert page.body("frame") == "bad" and page.enabled() <= SAFE
        page.press("hold")
        assert "NOT SENT" in page.text("#answers [data-for='hold']")
        own_stub.start()
        page.tab.clock.resume()
        own_stub.wait_received("token", 2)
        page.show(relayed(in_flight(t_s=5000.0, position_world_m=(0.0, 0.0, 1.55))))
        page.until_text("[data-figure='height']", "1.55")


def test_a_page_that_may_only_watch_says_why(stub: MonitorStub, shared: Page) -> None:
    stub.greeting[0] = hello(can_command=False, operator=None, why_not="this monitor was started with --view-only")
    shared.open_anew(stub)
    shared.show(relayed(in_flight()))
    assert shared.enabled() == set()
    assert shared.text("#commands-why") == "this monitor was started with --view-only"
    assert shared.tab.is_visible("#badge-view")
    shared.tab.keyboard.press("Shift+H")
    shared.show(hello())
    shared.press("abort")
    assert [message["command"] for message in stub.wait_received("command", 1)] == ["abort"]
