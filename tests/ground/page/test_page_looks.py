"""The page's appearance, measured: sizes, contrast, keyboard; and that its geometry is the controller's."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest

from companion.config.loader import load_flight
from companion.control.arm_model import manipulator_of
from companion.ground.telemetry.scene import scene_of
from companion.model.codec import to_jsonable
from companion.model.frames import quat_from_euler_zyx, quat_rotate
from tests.ground.monitor_stub import BROKER, MonitorStub, event, flown, hello, relayed, retained
from tests.ground.page_browser import SIZES, Page, events_of, watching
from tests.machines import overrides_with_joints
from tests.support import CATCH, HOVER

pytestmark = pytest.mark.xdist_group("browser")

TOUCH_PX = 56.0
LARGE_PX, LARGE_BOLD_PX = 24.0, 18.66
"""WCAG 2.2, 1.4.3: text of this size needs 3 : 1, all other 4.5 : 1."""


@pytest.fixture(scope="module")
def tablet(browser: Any) -> Iterator[tuple[Page, MonitorStub]]:
    """The page on a touch screen, and its stub."""
    with MonitorStub(retained()) as stub, watching(browser, stub, touch=True) as page:
        yield page, stub


@pytest.fixture
def touched(tablet: tuple[Page, MonitorStub]) -> Iterator[tuple[Page, MonitorStub]]:
    """Both, for a test that loads the page itself with `Page.open_anew`."""
    yield tablet
    tablet[0].check_complaints()


@pytest.fixture(scope="module")
def geometry(opened: tuple[Page, MonitorStub]) -> Page:
    """The page for tests that only call its geometry."""
    return opened[0]


@pytest.mark.parametrize("size", SIZES)
def test_nothing_scrolls_sideways_or_is_cut_off_and_safety_is_always_in_reach(
    touched: tuple[Page, MonitorStub], size: str
) -> None:
    """The header of a plot has room for one line; a second one is cut off."""
    page, stub = touched
    late = msgspec.structs.replace(flown().at(8.5).timing, lateness_ms=12.3, mocap_age_ms=16.5, whole_ms=10.4)
    page.open_anew(stub, size=size)
    page.show(relayed(msgspec.structs.replace(flown().at(8.5), timing=late)), relayed(flown().events))
    cut = page.tab.evaluate(
        "[...document.querySelectorAll('.plot header')].filter((h) => h.scrollHeight > h.clientHeight).map((h) => h.innerText)"
    )
    assert cut == [] and page.tab.locator(".plot header").count() >= 7
    for down_px in (0, 100_000):
        page.tab.evaluate("y => window.scrollTo(0, y)", down_px)
        wide, shown = page.tab.evaluate("[document.documentElement.scrollWidth, innerWidth]")
        assert wide <= shown
        for command in ("hold", "land", "abort"):
            _assert_in_reach(page, command)


def _assert_in_reach(page: Page, command: str) -> None:
    box = page.tab.locator(f"[data-command='{command}']").bounding_box()
    assert box["width"] >= TOUCH_PX and box["height"] >= TOUCH_PX
    middle = [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2]
    found = page.tab.evaluate(
        "([x, y]) => document.elementFromPoint(x, y)?.closest('[data-command]')?.dataset.command", middle
    )
    assert found == command


def test_every_control_of_a_tablet_is_large_enough(touched: tuple[Page, MonitorStub]) -> None:
    page, stub = touched
    page.open_anew(stub, size="tablet")
    page.show(*retained("second"))
    page.show(relayed(flown().at(8.5)))
    for control in page.tab.locator("button:visible, select:visible, summary:visible").all():
        box = control.bounding_box()
        assert box["height"] >= TOUCH_PX and box["width"] >= TOUCH_PX, control.inner_text()


def test_buttons_stay_where_they_are_when_things_go_wrong(shared: Page, stub: MonitorStub) -> None:
    """A finger may already be moving to a button."""
    for size in SIZES:
        shared.open_anew(stub, size=size)
        shared.show(relayed(flown().at(8.5)))

        def boxes() -> list[Any]:
            commands = ("hold", "land", "abort")
            return [shared.tab.locator(f"[data-command='{command}']").bounding_box() for command in commands]

        before = boxes()
        for command in ("hold", "land"):
            text = "no answer from the vehicle within 1.5 s: use Ctrl-C or the pilot's switch (sent again, 2 of 3)"
            shared.show({"kind": "refused", "vehicle": shared.shown, "command": command, "text": text})
        shared.run(5.0)
        assert shared.tab.is_visible("#stale") and boxes() == before
        shared.show({**BROKER, "rejected": 7, "rejected_text": "no JSON"})
        assert shared.tab.is_visible("#notice") and boxes() == before
        shared.show(hello(can_command=False, why_not="this monitor was started with --view-only"))
        assert shared.tab.is_visible("#commands-why") and boxes() == before


@pytest.mark.parametrize(("scheme", "stale"), [("dark", False), ("dark", True), ("light", True)])
def test_text_has_enough_contrast(shared: Page, stub: MonitorStub, scheme: str, stale: bool) -> None:
    shared.open_anew(stub, scheme=scheme)
    lines = [event(1, "a", severity="info"), event(2, "b"), event(3, "c", severity="critical")]
    shared.show(relayed(flown().at(8.5)), events_of(*lines))
    shared.show({"kind": "refused", "vehicle": shared.shown, "command": "land", "text": "no answer"})
    shared.tab.click("#control summary")
    shared.tab.click("#preflight summary")
    if stale:
        shared.run(2.0)
    weak = [text for text in shared.tab.evaluate(_CONTRAST, [LARGE_PX, LARGE_BOLD_PX]) if text]
    assert weak == []


_CONTRAST = """([large, largeBold]) => {
  const parts = (colour) => {
    const srgb = colour.startsWith("color(srgb");
    const [r, g, b, a = 1] = colour.replace(/^[a-z]+\\((srgb )?/, "").match(/[\\d.]+/g).map(Number);
    return { rgb: srgb ? [r, g, b] : [r / 255, g / 255, b / 255], a };
  };
  const luminance = (rgb) => {
    const [r, g, b] = rgb.map((c) => (c <= 0.03928 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const behind = (element) => {
    for (let e = element; e; e = e.parentElement) {
      const { rgb, a } = parts(getComputedStyle(e).backgroundColor);
      if (a > 0.99) return rgb;
    }
    throw new Error("nothing is behind it");
  };
  return [...document.querySelectorAll("body *")].map((element) => {
    const own = [...element.childNodes].filter((n) => n.nodeType === 3).map((n) => n.textContent.trim()).join("");
    if (!own || !element.checkVisibility({ visibilityProperty: true }) || element.closest(".unseen, .skip, select")) return null;
    const style = getComputedStyle(element);
    const [one, two] = [luminance(parts(style.color).rgb), luminance(behind(element))];
    const ratio = (Math.max(one, two) + 0.05) / (Math.min(one, two) + 0.05);
    const size = parseFloat(style.fontSize);
    const needed = size >= large || (size >= largeBold && Number(style.fontWeight) >= 700) ? 3 : 4.5;
    return ratio < needed ? `${own}: ${ratio.toFixed(2)}` : null;
  });
}"""


def test_everything_can_be_reached_by_keyboard_and_the_commands_first(page: Page) -> None:
    page.show(relayed(flown().at(8.5)))
    page.tab.keyboard.press("Tab")
    page.tab.keyboard.press("Enter")
    order = []
    for _ in range(3):
        page.tab.keyboard.press("Tab")
        order.append(page.tab.evaluate("document.activeElement.dataset.command"))
    assert order == ["hold", "land", "abort"]


def test_the_camera_moves_by_mouse_wheel_and_keys(page: Page) -> None:
    page.show(relayed(flown().at(8.5)))

    def picture() -> str:
        page.run(0.5)
        found: str = page.tab.evaluate("document.getElementById('scene').toDataURL()")
        return found

    seen = [picture()]
    for preset in ("behind", "top", "side", "room"):
        page.tab.click(f"[data-preset='{preset}']")
        seen.append(picture())
    assert seen[0] == seen[4] and len(set(seen)) == 4
    page.tab.hover("#scene")
    page.tab.mouse.down()
    page.tab.mouse.move(400, 400)
    page.tab.mouse.up()
    seen.append(picture())
    page.tab.evaluate("window.wheels = 0; addEventListener('wheel', () => { window.wheels += 1; })")
    page.tab.mouse.wheel(0, -300)
    page.until("() => window.wheels > 0")
    seen.append(picture())
    page.tab.focus("#scene")
    page.tab.keyboard.press("ArrowLeft")
    seen.append(picture())
    assert len(set(seen)) == 7


@pytest.mark.parametrize(("count", "change"), [(1, []), (2, []), (4, ["vehicle.arm.joints[0].axis=[0, 0, 1]"])])
def test_the_arm_is_drawn_as_the_controller_knows_it(geometry: Page, count: int, change: list[str]) -> None:
    config = load_flight(CATCH, overrides=[*overrides_with_joints(count), *change])
    arm = manipulator_of(config.vehicle)
    angles = list(itertools.product((-0.5, 0.4, 2.9), repeat=count))
    script = "const { armBody } = await import('/geometry.js'); return a.map((q) => armBody(scene, q));"
    drawn = geometry.tab.evaluate(
        f"async ([scene, a]) => {{ {script} }}", [to_jsonable(scene_of(config, "s")), [list(one) for one in angles]]
    )
    for one, parts in zip(angles, drawn, strict=True):
        for joint, expected in zip(parts["joints"], arm.joints_body_m(one), strict=True):
            assert joint == pytest.approx(expected, abs=1e-12)
        assert parts["net"] == pytest.approx(arm.net_body_m(one), abs=1e-12)


@pytest.mark.parametrize("count", [0, 4])
def test_the_plot_of_the_arm_has_every_joint_and_is_absent_without_one(
    shared: Page, stub: MonitorStub, count: int
) -> None:
    scene = scene_of(load_flight(HOVER, overrides=overrides_with_joints(count)), flown().scene.session)
    arm_rad = (0.1, 0.2, 0.3, 0.4)[:count] or None
    stream = msgspec.structs.replace(flown().at(8.5), arm_rad=arm_rad, reference_arm_rad=arm_rad)
    shared.open_anew(stub)
    shared.show(relayed(scene), relayed(stream))
    shared.run(0.5)
    assert shared.tab.locator("#plots").inner_text().count("α") == count
    titles = shared.tab.locator(".plot h2").all_inner_texts()
    assert [title for title in titles if title.startswith("Arm")] == ["Arm, °"] * (count > 0)
    assert len(titles) == 6 + (count > 0)


def test_vectors_turn_as_the_controller_turns_them(geometry: Page) -> None:
    q, v = quat_from_euler_zyx(0.3, -0.4, 2.0), (0.3, -1.2, 0.7)
    script = "async ([q, v]) => (await import('/geometry.js')).rotate(q, v)"
    assert geometry.tab.evaluate(script, [list(q), list(v)]) == pytest.approx(quat_rotate(q, v), abs=1e-12)


@pytest.mark.parametrize(
    ("end", "length_m", "floor_m"),
    [
        ((1.5, 0.8, 1.2), 2.2, -9.0),  # hangs free
        ((1.5, 0.8, 1.2), 3.0, -9.0),
        ((0.0, 0.0, 1.0), 3.0, -9.0),  # straight above the anchor
        ((1.5, 0.8, 1.2), 2.2, 0.0),  # lies on the floor in part
        ((1.0, -0.5, 1.0), 2.0, 0.0),
        ((-1.8, 0.2, -0.3), 2.5, -1.0),  # both ends in the air
    ],
)
def test_the_tether_has_its_length_and_its_ends(
    geometry: Page, end: tuple[float, float, float], length_m: float, floor_m: float
) -> None:
    script = "async ([a, b, l, f]) => (await import('/geometry.js')).hanging(a, b, l, f)"
    points = geometry.tab.evaluate(script, [[0.0, 0.0, 0.0], list(end), length_m, floor_m])
    assert points[0] == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
    assert points[-1] == pytest.approx(end, abs=1e-6)
    assert sum(math.dist(a, b) for a, b in itertools.pairwise(points)) == pytest.approx(length_m, rel=0.01)
    assert min(point[2] for point in points) >= floor_m - 1e-6
