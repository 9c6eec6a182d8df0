"""Pictures of the monitor's page for the documentation: `python -m tests.ground.pictures [FOLDER]` (default: docs/pictures).

A flight of the fast loop, shown by the page in headless Chromium; `tests/ground/monitor_stub.py` plays the monitor.
"""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from companion.ground.protocol.messages import Presence
from companion.model.codec import to_jsonable
from tests.ground.monitor_stub import MonitorStub, ack, event, flown, hello, preflight, relayed, retained, state
from tests.ground.page_browser import Page, chromium, events_of, greeted, watching
from tests.support import ROOT

NONCE = "0123456789abcdef" * 2


@dataclass(frozen=True)
class Picture:
    """One picture: name, size and colour scheme of the screen, and the actions before it is taken."""

    name: str
    size: str
    scheme: str
    act: Callable[[Page, MonitorStub], None]


def _fly(page: Page, until_s: float, **changes: object) -> None:
    """Send the flight up to a mission time, the last record with changes."""
    past = [stream for stream in flown().streams if stream.mission_t_s <= until_s]
    lines = [line for line in flown().events.lines if line.t_s <= past[-1].t_s]
    messages = [relayed(stream) for stream in past]
    messages[-1]["data"] |= changes
    page.show(*messages, events_of(*lines))
    page.run(0.2)


def _flying(page: Page, stub: MonitorStub) -> None:
    _fly(page, 8.5)


def _holding(page: Page, stub: MonitorStub) -> None:
    page.show(relayed(flown().streams[0]))
    page.press("hold")
    stub.wait_received("command", 1)
    page.show(
        {"kind": "sent", "vehicle": page.shown, "command": "hold", "nonce": NONCE},
        relayed(ack("hold", NONCE, "stops on the planned path and holds")),
    )
    page.tab.click("[data-preset='behind']")
    _fly(page, 8.5, action="hold")
    lines = [line for line in flown().events.lines if line.id in ("takeoff", "catch")]
    asked = event(0, "operator anna asks for a hold", id_="operator_hold")
    page.show(events_of(*lines, asked))


def _stale(page: Page, stub: MonitorStub) -> None:
    _fly(page, 8.5)
    page.run(2.1)


def _replayed(page: Page, stub: MonitorStub) -> None:
    script = (
        "t => { const s = document.getElementById('replay-time'); s.value = t; s.dispatchEvent(new Event('input')); }"
    )
    page.tab.evaluate(script, flown().at(7.2).t_s)
    page.run(0.5)


PICTURES = (
    Picture("monitor_desktop", "desktop", "dark", _flying),
    Picture("monitor_tablet", "tablet", "light", _holding),
    Picture("monitor_stale", "small", "dark", _stale),
)
REPLAY = Picture("monitor_replay", "desktop", "light", _replayed)


def take(folder: Path) -> list[Path]:
    """Take all pictures and write them to files."""
    made = []
    with chromium() as browser:
        for picture in (*PICTURES, REPLAY):
            with MonitorStub(retained()) as stub:
                settle = greeted
                if picture is REPLAY:
                    stub.greeting = [hello(can_command=False, replay=True, logs=["flight.mcap"], why_not="a log")]
                    stub.replay = [_log()]
                    settle = _loaded
                with watching(browser, stub, size=picture.size, scheme=picture.scheme, settle=settle) as page:
                    picture.act(page, stub)
                    path = folder / f"{picture.name}.png"
                    _write(page.tab.screenshot(), path)
                    made.append(path)
    return made


def _write(png: bytes, path: Path) -> None:
    """Write with 256 colours, enough for the page, at a third of the size."""
    picture = Image.open(io.BytesIO(png)).convert("RGB")
    picture.quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)


def _loaded(page: Page) -> None:
    page.until("() => document.querySelectorAll('#replay-marks span').length > 0")


def _log() -> dict[str, object]:
    ended = state(Presence.ENDED, outcome="completed", commands=False)
    parts = {"state": ended, "scene": flown().scene, "preflight": preflight(), "events": flown().events}
    streams = [to_jsonable(stream) for stream in flown().streams]
    return {**{name: to_jsonable(part) for name, part in parts.items()}, "streams": streams}


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="tests.ground.pictures", description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=ROOT / "docs/pictures")
    for path in take(parser.parse_args(argv).folder):
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
