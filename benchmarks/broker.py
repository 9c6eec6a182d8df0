"""Measures what an MQTT broker costs the control loop, absent, healthy and disturbed: one flight, one condition after the other.

    python -m benchmarks.broker                    # 3 rounds of 8 conditions, 16 s each: 9 minutes of hovering
    python -m benchmarks.broker --rounds 1 --slot 10 --json FILE

All conditions are met by one and the same flight, in an order drawn anew for each round, so that what the machine does meanwhile meets
all of them alike. Exit code 0 only if the flight was completed, nothing was dropped, and no condition makes ticks later than no broker
does (p99 by more than a quarter and a tenth of a period, which is what two runs without a broker differ by).
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from rich.console import Console

from benchmarks.measuring.hovering import END_TIMEOUT_S, MISSION, NoFlight, await_hover, start_hover
from benchmarks.report import number, print_table, write_json
from benchmarks.soaking.lateness import run_idle_ticks
from companion.analysis.log import FlightLog
from companion.config.ground import topic_name
from companion.config.loader import load_flight
from companion.model.constants import TICK_PERIOD_S
from tests.broker import LOOPBACK, Broker, free_port

SETTLE_S = 3.0
"""Time between two conditions, not counted."""
P99_RATIO_MAX = 1.25
P99_MORE_MAX_MS = 0.5
NO_BROKER = "no broker"


@dataclass(frozen=True, slots=True)
class Slot:
    """A condition with its beginning and end on the wall clock."""

    condition: str
    begin_s: float
    end_s: float


Row = dict[str, Any]
"""All ticks of one condition; lateness in ms, of the flight and of the empty loop."""


class Conditions:
    """The conditions of the broker; each of them cleans up behind itself."""

    def __init__(self, folder: Path, vehicle: str) -> None:
        self.port = free_port()
        self._vehicle = vehicle
        config = folder / "loopback.conf"
        text = LOOPBACK.read_text(encoding="utf-8")
        config.write_text(text.replace("listener 1883 127.0.0.1\n", f"listener {self.port} 127.0.0.1\n"))
        self.broker = Broker(folder, config, self.port)
        self.all: dict[str, Callable[[float], None]] = {
            NO_BROKER: self.nothing,
            "broker": self.plain,
            "killed, restarted": self.killed,
            "slow": self.slow,
            "retained garbage": lambda s: self.loaded("garbage", s),
            "20 viewers": lambda s: self.loaded("viewers", s),
            "1,000 commands/s": lambda s: self.loaded("noise", s),
        }

    def nothing(self, seconds: float) -> None:
        """No broker listens on the port."""
        time.sleep(seconds)

    def plain(self, seconds: float) -> None:
        """A broker without other clients."""
        with self._broker():
            time.sleep(seconds)

    def killed(self, seconds: float) -> None:
        """A broker that is killed and restarted again and again."""
        end_s = time.monotonic() + seconds
        with self._broker():
            while time.monotonic() < end_s:
                time.sleep(2.0)
                self.broker.kill()
                time.sleep(1.0)
                self.broker.start()

    def slow(self, seconds: float) -> None:
        """A broker that runs for a twentieth of the time: its socket fills up and is emptied in bursts."""
        end_s = time.monotonic() + seconds
        with self._broker():
            while time.monotonic() < end_s:
                self.broker.signal(signal.SIGSTOP)
                time.sleep(1.9)
                self.broker.signal(signal.SIGCONT)
                time.sleep(0.1)

    def loaded(self, load: str, seconds: float) -> None:
        """A broker under load from other clients."""
        with self._broker():
            command = [sys.executable, "-m", "benchmarks.brokering.load", load, self.broker.url, self._vehicle]
            process = subprocess.Popen(command)
            try:
                time.sleep(seconds)
                if process.poll() is not None:
                    raise SystemExit(f"broker: the load {load!r} ended by itself, exit code {process.returncode}")
            finally:
                process.terminate()
                process.wait(30.0)

    @contextlib.contextmanager
    def _broker(self) -> Iterator[None]:
        self.broker.start()
        try:
            yield
        finally:
            self.broker.stop()


def fly(rounds: int, slot_s: float, folder: Path, console: Console) -> tuple[list[Slot], int]:
    """Hover through all conditions; return when each of them applied, and the flight's exit code."""
    config = load_flight(MISSION)
    conditions = Conditions(folder, topic_name(config.vehicle.ground.topic, config.vehicle.name))
    order = random.Random(1)
    names = [
        name for _ in range(rounds) for name in order.sample([*conditions.all, NO_BROKER], len(conditions.all) + 1)
    ]
    hover_s = len(names) * (slot_s + 3.0 + SETTLE_S) + 10.0
    empty = subprocess.Popen([sys.executable, "-m", "benchmarks.broker", "--empty-loop", str(folder / "empty.npy")])
    slots: list[Slot] = []
    flight = start_hover(folder, hover_s, conditions.broker.url)
    try:
        await_hover(flight, folder)
        time.sleep(SETTLE_S)
        for number, name in enumerate(names, 1):
            if flight.poll() is not None:
                break
            console.print(f"  {number:>2}/{len(names)}  {name}", highlight=False)
            begin_s = time.time() + SETTLE_S
            conditions.all[name](slot_s + SETTLE_S)
            slots.append(Slot(name, begin_s, begin_s + slot_s))
        if flight.poll() is None:
            flight.send_signal(signal.SIGINT)
        flight.wait(END_TIMEOUT_S)
    except NoFlight as error:
        raise SystemExit(f"broker: no flight: {error}") from None
    finally:
        for process in (flight, empty):
            if process.poll() is None:
                process.terminate()
                process.wait(END_TIMEOUT_S)
    return slots, flight.returncode


def judge(slots: list[Slot], folder: Path) -> list[Row]:
    """Return the lateness of flight and empty loop by condition."""
    log = folder / "flight/flight.mcap"
    offset_s = int(FlightLog.read(log, ticks_max=1000).metadata["companion"]["epoch_offset_ns"]) * 1e-9
    starts, lateness = [], []
    with log.open("rb") as file:
        for _, _, message in make_reader(file).iter_messages(topics=["/sent"], log_time_order=False):
            sent: dict[str, Any] = json.loads(message.data)
            starts.append(offset_s + sent["start_s"])
            lateness.append(1e3 * sent["lateness_s"])
    flown = np.array([starts, lateness])
    empty: Any = np.load(folder / "empty.npy")
    rows = []
    for condition in dict.fromkeys(slot.condition for slot in slots):
        own = [slot for slot in slots if slot.condition == condition]
        ticks, beside = (_within(ticks, own) for ticks in (flown, empty))
        rows.append({"condition": condition, "ticks": len(ticks), **_lateness(ticks), "empty": _lateness(beside)})
    return sorted(rows, key=lambda row: bool(row["condition"] != NO_BROKER))


def _lateness(ticks_ms: Any) -> dict[str, Any]:
    p50, p99, p999 = map(float, np.percentile(ticks_ms, [50.0, 99.0, 99.9]))
    missed = int((ticks_ms > 1e3 * TICK_PERIOD_S).sum())
    return {"p50": p50, "p99": p99, "p999": p999, "max": float(ticks_ms.max()), "missed": missed}


def _within(ticks: Any, slots: list[Slot]) -> Any:
    inside = np.zeros(ticks.shape[1], dtype=bool)
    for slot in slots:
        inside |= (ticks[0] >= slot.begin_s) & (ticks[0] < slot.end_s)
    return ticks[1][inside]


def run_empty_loop(path: Path) -> None:
    """Run an empty loop, then write wall clock (s) and lateness (ms) of each tick."""
    offset_s = time.time() - time.monotonic()
    starts, lateness = array("d"), array("d")

    def take(start_s: float, lateness_s: float) -> None:
        starts.append(offset_s + start_s)
        lateness.append(1e3 * lateness_s)

    run_idle_ticks(take)
    np.save(path, np.array([starts, lateness]))


def problems_of(rows: list[Row], code: int, summary: dict[str, Any]) -> list[str]:
    """Return the limits that were not met."""
    found = [] if code == 4 else [f"the flight ended with exit code {code}, 4 (landed on demand) was expected"]
    if summary["recorder"]["dropped"]:
        found.append(f"recorder: {summary['recorder']['dropped']} dropped")
    none_ms = rows[0]["p99"]
    for row in rows:
        if row["p99"] > P99_RATIO_MAX * none_ms and row["p99"] > none_ms + P99_MORE_MAX_MS:
            found.append(f"{row['condition']}: p99 {row['p99']:.2f} ms, without a broker {none_ms:.2f} ms")
    return found


def said(summary: dict[str, Any]) -> list[str]:
    """Return the flight's warnings; some come from stalls of the whole computer, which delay the empty loop too."""
    asked_for = ("operator_land", "ground")
    return [
        event["text"] for event in summary["events"] if event["severity"] != "info" and event["id"] not in asked_for
    ]


def cells(row: Row, none_ms: float) -> dict[str, str]:
    """Return the row of the table; `none_ms` is p99 without a broker."""
    empty = row["empty"]
    return {
        "condition": row["condition"],
        "ticks": str(row["ticks"]),
        **{name: number(row[key]) for name, key in (("p50", "p50"), ("p99", "p99"), ("p99.9", "p999"), ("max", "max"))},
        "missed": str(row["missed"]),
        "p99 / no broker": number(row["p99"] / none_ms),
        **{f"empty loop {key}": number(empty[key]) for key in ("p50", "p99", "max")},
        "empty loop missed": str(empty["missed"]),
    }


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.broker", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--slot", type=float, default=16.0, help="seconds of each condition that count")
    parser.add_argument("--json", type=Path, help="write the figures here as well")
    parser.add_argument("--out", type=Path, help="keep the flight in this folder; must not exist")
    parser.add_argument("--empty-loop", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args(argv)
    if arguments.empty_loop is not None:
        run_empty_loop(arguments.empty_loop)
        return 0
    console = Console(width=150)
    with tempfile.TemporaryDirectory() as scratch:
        folder = arguments.out or Path(scratch) / "run"
        if folder.exists():
            parser.error(f"{folder} exists already; choose another --out")
        folder.mkdir(parents=True)
        slots, code = fly(arguments.rounds, arguments.slot, folder, console)
        rows = judge(slots, folder)
        summary = json.loads((folder / "flight/summary.json").read_text())
    print_table("lateness of ticks, ms", [cells(row, rows[0]["p99"]) for row in rows], console)
    for text in said(summary):
        console.print(f"the flight said: {text}", highlight=False)
    problems = problems_of(rows, code, summary)
    for problem in problems:
        console.print(problem, style="red", highlight=False)
    write_json(arguments.json, {"rows": rows, "problems": problems})
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
