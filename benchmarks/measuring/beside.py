"""Loops that run beside a flight, each in a separate process.

python -m benchmarks.measuring.beside empty FILE          # empty ticks until SIGTERM; start and lateness of each, s, as .npy
python -m benchmarks.measuring.beside plain FILE          # the same on asyncio's own event loop
python -m benchmarks.measuring.beside bare FILE FRAMES    # receives and sends on native MAVSDK; its latency as JSON
"""

from __future__ import annotations

import json
import signal
import sys
from array import array
from dataclasses import asdict
from pathlib import Path

import numpy as np

from benchmarks.measuring.wires import bare_mavsdk
from benchmarks.soaking.lateness import run_idle_ticks


def empty(path: Path, *, plain: bool) -> None:
    """Run an empty loop; with `plain`, on asyncio's own event loop.

    Rows of the array: `time.monotonic` at the start of each tick, and its lateness."""
    starts_s, lateness_s = array("d"), array("d")

    def take(start_s: float, late_s: float) -> None:
        starts_s.append(start_s)
        lateness_s.append(late_s)

    run_idle_ticks(take, plain=plain)
    np.save(path, np.array([starts_s, lateness_s]))


def bare(path: Path, frames: int) -> None:
    """Run the bare loop and the process at the other end of its wires."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    inside, wire = bare_mavsdk(frames)
    path.write_text(json.dumps({"inside": asdict(inside), "wire": asdict(wire)}), encoding="utf-8")


if __name__ == "__main__":
    if sys.argv[1] in ("empty", "plain"):
        empty(Path(sys.argv[2]), plain=sys.argv[1] == "plain")
    else:
        bare(Path(sys.argv[2]), int(sys.argv[3]))
