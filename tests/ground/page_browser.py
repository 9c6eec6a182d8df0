"""Headless Chromium with the page. The page's clock stands still until a test advances it, so nothing waits for real time."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from msgspec.structs import replace
from playwright.sync_api import sync_playwright

from companion.ground.protocol.messages import VERSION, Events, Preflight, PreflightRow, Stream
from tests.browser import ARGUMENTS
from tests.browser import chromium as chromium_path
from tests.ground.monitor_stub import NAME, SESSION, Message, MonitorStub, relayed
from tests.support import DEADLINE_S

SIZES = {"desktop": (1440, 900), "small": (1024, 768), "tablet": (768, 1024)}
_marks = itertools.count()


@contextmanager
def chromium() -> Iterator[Any]:
    """Start the browser; skip the test if there is none."""
    path = chromium_path()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(ARGUMENTS))
        yield browser
        browser.close()


class Page:
    """The page in one tab.

    Attributes:
        shown: name of the displayed vehicle.
        complaints: errors and warnings of the browser, including violations of the content security policy.
    """

    def __init__(self, context: Any, stub: MonitorStub | None, script: str) -> None:
        self._stub = stub
        self._number = itertools.count()
        self.shown = NAME
        self.complaints: list[str] = []
        self.tab = context.new_page()
        self.tab.set_default_timeout(DEADLINE_S * 1e3)
        self.tab.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.tab.on("console", self._hear)
        self.tab.add_init_script(
            "window.violations = []; addEventListener('securitypolicyviolation', (e) => violations.push(e.blockedURI))"
        )
        self.tab.add_init_script(script)
        self.tab.clock.install(time=0)

    def _hear(self, message: Any) -> None:
        if message.type in ("error", "warning"):
            self.complaints.append(message.text)

    def open(self, url: str, settle: Callable[[Page], None]) -> None:
        self.tab.goto(url)
        settle(self)
        self.tab.clock.pause_at(self.tab.evaluate("Date.now()") + 1000)

    def open_anew(self, stub: MonitorStub, *, size: str = "small", scheme: str = "dark") -> None:
        """Load the page anew, without any state of before. This takes a third of the CPU time of a new tab."""
        stub.hang_up()
        self.shown = NAME
        self.complaints.clear()
        self.tab.mouse.move(0, 0)
        width, height = SIZES[size]
        self.tab.set_viewport_size({"width": width, "height": height})
        self.tab.emulate_media(color_scheme=scheme, reduced_motion="reduce")
        self.tab.goto(stub.url.replace("#", f"?{next(self._number)}#"))
        greeted(self)
        self.tab.clock.fast_forward(1000)

    def check_complaints(self, may: str = "") -> None:
        """Fail if the browser complained of anything that does not contain `may`."""
        assert self.tab.evaluate("window.violations") == []
        assert [text for text in self.complaints if not may or may not in text] == []

    def show(self, *messages: Message) -> None:
        """Send messages through the stub and wait until the page has displayed them."""
        mark = f"mark {next(_marks)}"
        known = Preflight(VERSION, SESSION, (PreflightRow("mark", "ok", mark),))
        assert self._stub is not None
        self._stub.send(*messages, relayed(known, self.shown))
        self.until("mark => document.getElementById('preflight-list').textContent.includes(mark)", mark)

    def run(self, seconds: float) -> None:
        """Advance the page's clock."""
        self.tab.clock.run_for(round(seconds * 1000))

    def until(self, expression: str, argument: object = None) -> None:
        """Wait until a JavaScript expression is true in the page."""
        self.tab.wait_for_function(expression, arg=argument, polling=20)

    def text(self, selector: str) -> str:
        """Return the text of an element in one line."""
        return " ".join(self.tab.locator(selector).inner_text().split())

    def until_text(self, selector: str, text: str) -> None:
        self.until("([s, t]) => document.querySelector(s)?.textContent.includes(t)", [selector, text])

    def figure(self, name: str) -> str:
        return self.text(f"[data-figure='{name}']")

    def body(self, name: str) -> str:
        found: str = self.tab.evaluate("name => document.body.dataset[name]", name)
        return found

    def press(self, command: str) -> None:
        self.tab.click(f"[data-command='{command}']")

    def enabled(self) -> set[str]:
        """Return the names of the enabled commands."""
        return set(
            self.tab.evaluate("[...document.querySelectorAll('[data-command]:enabled')].map((b) => b.dataset.command)")
        )


def greeted(page: Page) -> None:
    """Wait until the page knows whether it may command."""
    page.until("() => document.querySelector('#operator').textContent || !document.querySelector('#badge-view').hidden")


@contextmanager
def watching(
    browser: Any,
    source: MonitorStub | str,
    *,
    size: str = "small",
    scheme: str = "dark",
    touch: bool = False,
    may: str = "",
    script: str = "",
    settle: Callable[[Page], None] = greeted,
) -> Iterator[Page]:
    """Open the page.

    Args:
        browser: the browser.
        source: the stub, or the address of a monitor.
        size: one of `SIZES`.
        scheme: ``dark`` or ``light``.
        touch: emulate a touch screen.
        may: complaints of the browser that contain this are allowed.
        script: runs in the page before its own scripts.
        settle: waits until the page is ready; then its clock is stopped.
    """
    width, height = SIZES[size]
    context = browser.new_context(
        viewport={"width": width, "height": height}, color_scheme=scheme, has_touch=touch, reduced_motion="reduce"
    )
    stub = source if isinstance(source, MonitorStub) else None
    page = Page(context, stub, script)
    try:
        page.open(source if isinstance(source, str) else source.url, settle)
        yield page
        page.check_complaints(may)
    finally:
        context.close()


def playing(stream: Stream, **changes: Any) -> Callable[[], Message]:
    """Return a function that returns the record with increasing times: the page's clock stands still, the vehicle's runs."""
    numbers = itertools.count(1)
    return lambda: relayed(replace(stream, t_s=1000.0 + 100.0 * next(numbers), **changes))


def events_of(*lines: Any, vehicle: str = NAME) -> Message:
    return relayed(Events(v=VERSION, session=SESSION, count=len(lines), lines=tuple(lines)), vehicle)
