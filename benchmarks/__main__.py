"""Measures every published figure of timing and cost beside a bare reference, and writes one page.

    python -m benchmarks                      # everything: 14 minutes, 10 of them a hover
    python -m benchmarks --quick              # the hover lasts one minute
    python -m benchmarks --only core          # one part; the others are kept from an earlier run
    python -m benchmarks --page               # docs/internals/benchmarks.md from the last run; nothing is measured

Writes results.json and results.md into --out, and the files of each part into a folder of its own there. Every part runs in a separate
process and is saved as soon as it is measured; a failed part is one line on the page and does not end the others. Ctrl-C lands the
flight, ends all processes, and keeps the measured parts. Exit code 0 only if everything was measured and every target is met.
"""

from __future__ import annotations

import argparse
import contextlib
import datetime
import importlib
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.measuring.figures import problems
from benchmarks.measuring.page import markdown, show
from benchmarks.measuring.rows import sections
from companion.recorder.versions import versions
from companion.runtime.files import write_whole
from tools.compiled import BUILD

ROOT = Path(__file__).parents[1]
OUT = ROOT / "build" / "benchmarks"
PAGE = ROOT / "docs" / "internals" / "benchmarks.md"
DEADLINE_S = {"core": 300.0, "compiled": 300.0, "pi": 300.0, "joints": 120.0, "setpoint": 900.0, "hover": 1500.0}
"""Deadline of each part, in the order in which they run."""
LAND_S = 400.0
"""Time that a part has to end after Ctrl-C: its flight lands first."""
SAMPLES, QUICK_SAMPLES = 4000, 1000
VERSIONS = ("companion", "git", "python", "mavsdk", "pymavlink", "dynamixel-sdk", "mujoco")

Say = Callable[[str], None]


# --- in the process of a part -------------------------------------------------------------------------------------------------------


PARTS: dict[str, tuple[str, Callable[[Any, Path, bool, Say], dict[str, Any]]]] = {
    "core": ("core", lambda part, folder, quick, say: part.measure(say, 2 if quick else part.REPEATS)),
    "compiled": ("core", lambda part, folder, quick, say: part.measure_compiled(say, 2 if quick else part.REPEATS)),
    "pi": ("pi", lambda part, folder, quick, say: part.measure(say)),
    "joints": ("bus", lambda part, folder, quick, say: part.measure(folder, QUICK_SAMPLES if quick else SAMPLES, say)),
    "setpoint": ("setpoint", lambda part, folder, quick, say: part.measure(QUICK_SAMPLES if quick else SAMPLES, say)),
    "hover": ("hover", lambda part, folder, quick, say: part.measure(folder, part.QUICK_HOVER_S if quick else part.HOVER_S, say)),
}  # fmt: skip
"""The module of each part in `benchmarks.measuring`, and how it measures."""


def run_part(name: str, folder: Path, quick: bool) -> int:
    """Measure one part in this process and leave its figures in its folder."""

    def say(text: str) -> None:
        print(f"  {name}: {text}", flush=True)

    try:
        module, measure = PARTS[name]
        figures = measure(importlib.import_module(f"benchmarks.measuring.{module}"), folder, quick, say)
    except KeyboardInterrupt:
        return 130
    except Exception as error:  # any error is one line on the page, and the other parts continue
        print(" ".join(str(error).split()) or type(error).__name__, file=sys.stderr)
        return 1
    write_whole(folder / "figures.json", (json.dumps(figures, indent=1) + "\n").encode())
    return 0


# --- in the process that the user started -------------------------------------------------------------------------------------------


def measure(name: str, out: Path, quick: bool) -> dict[str, Any]:
    """Run a part in a separate process and return its entry in the results, with the reason if it failed."""
    folder = out / name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    words = ["--part", name, "--out", str(out), *(["--quick"] if quick else [])]
    begun_s = time.monotonic()
    with (folder / "stderr.txt").open("wb") as stderr:
        pressed: list[int] = []
        before = signal.signal(signal.SIGINT, lambda number, _: pressed.append(number))  # while the part starts
        first = (BUILD, ROOT) if name == "compiled" else (ROOT,)
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "benchmarks", *words],
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, first))},
            stderr=stderr,
            start_new_session=True,
        )
        try:
            signal.signal(signal.SIGINT, before)
            if pressed:
                raise KeyboardInterrupt
            code = process.wait(DEADLINE_S[name])
        except subprocess.TimeoutExpired:
            code = None
        finally:
            _end(process)
    entry: dict[str, Any] = {
        "quick": quick,
        "took_s": round(time.monotonic() - begun_s, 1),
        "failed": None,
        "figures": {},
    }
    if code is None:
        entry["failed"] = f"the part took longer than {DEADLINE_S[name]:g} s"
    elif code != 0:
        said = (folder / "stderr.txt").read_text(encoding="utf-8", errors="replace").strip().splitlines()
        entry["failed"] = said[-1] if said else f"the part ended with exit code {code}"
    else:
        entry["figures"] = json.loads((folder / "figures.json").read_text(encoding="utf-8"))
    return entry


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a part that still runs, and ignore further Ctrl-C meanwhile; kill it after `LAND_S`."""
    if process.poll() is not None:
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    print("  ending what was started: a flight lands first", flush=True)
    try:
        process.send_signal(signal.SIGINT)
        process.wait(LAND_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    finally:
        signal.signal(signal.SIGINT, before)


def read_results(out: Path) -> dict[str, Any]:
    """Return the results of an earlier run; no parts if there are none."""
    try:
        found: dict[str, Any] = json.loads((out / "results.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {"parts": {}}
    return found


def write_results(results: Mapping[str, Any], out: Path) -> None:
    """Write both result files, each of them atomically."""
    tables = tables_of(results)
    rows = [
        {**asdict(row), "ratios": row.ratios, "verdict": row.verdict.strip("*")}
        for table in tables
        for row in table.rows
    ]
    write_whole(out / "results.json", (json.dumps({**results, "rows": rows}, indent=1) + "\n").encode())
    write_whole(out / "results.md", markdown(results, tables).encode())


def tables_of(results: Mapping[str, Any]) -> Sequence[Any]:
    """Return the tables of all parts."""
    parts: Mapping[str, Any] = results["parts"]
    return sections(
        {name: {"not_measured": part["failed"]} if part["failed"] else part["figures"] for name, part in parts.items()}
    )


def about() -> dict[str, Any]:
    """Return date, computer and versions."""
    found = versions()
    if "git" in found:
        found["git"] = found["git"][:12] + found["git"][40:]  # and "-dirty"
    cpu = platform.machine()
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        cpu = next(line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "Model")))
    return {
        "date": datetime.date.today().isoformat(),
        "computer": f"{cpu}, {os.cpu_count()} cores, Linux {platform.release()}",
        "versions": {name: found[name] for name in VERSIONS if name in found},
    }


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--only", action="append", choices=list(PARTS), metavar="NAME", help=f"this part: {', '.join(PARTS)}"
    )
    parser.add_argument("--quick", action="store_true", help="a minute of hover instead of ten, fewer samples")
    parser.add_argument(
        "--out", type=Path, default=OUT, metavar="DIR", help="for results and logs (default: build/benchmarks)"
    )
    parser.add_argument(
        "--page",
        action="store_true",
        help="write docs/internals/benchmarks.md from the results in --out; measure nothing",
    )
    parser.add_argument("--part", choices=list(PARTS), help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    out: Path = options.out.resolve()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background shell ignores it
    if options.part is not None:
        return run_part(options.part, out / options.part, options.quick)
    results = read_results(out)
    if options.page:
        if not results["parts"]:
            parser.exit(2, f"benchmarks: {options.out} holds no results; run python -m benchmarks first\n")
        write_whole(PAGE, markdown(results, tables_of(results)).encode())
        print(PAGE)
        return 0
    signal.signal(signal.SIGTERM, lambda *_: signal.raise_signal(signal.SIGINT))
    names = options.only or list(PARTS)
    results = {"made": about(), "parts": results["parts"] if options.only else {}}
    out.mkdir(parents=True, exist_ok=True)
    console = Console()
    try:
        for number, name in enumerate(names, 1):
            console.print(f"{number}/{len(names)} {name}", highlight=False)
            results["parts"][name] = entry = measure(name, out, options.quick)
            write_results(results, out)
            if entry["failed"]:
                console.print(
                    f"  {name} was not measured: {entry['failed']}", style="red", highlight=False, soft_wrap=True
                )
    except KeyboardInterrupt:
        console.print(f"cancelled; the measured parts are in {options.out}", highlight=False)
        return 130
    tables = tables_of(results)
    show(results, tables, console if console.is_terminal else Console(width=200))
    print(f"{options.out}/results.md")
    return 1 if problems(tables) or any(part["failed"] for part in results["parts"].values()) else 0


if __name__ == "__main__":
    sys.exit(main())
