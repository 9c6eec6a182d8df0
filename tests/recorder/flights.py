"""Flights for tests of the recorder, and a recorder for flights."""

from __future__ import annotations

import math
import select
from collections.abc import Iterable, Iterator
from pathlib import Path

from msgspec.structs import replace

from companion.config.loader import load_flight
from companion.model.outputs import Outputs, Sent
from companion.model.types import Inputs
from companion.recorder.client import RecorderProcess
from sitl.fast.result import FastResult
from tests.analysis.synthetic_flight import sent_at, synthetic_flight
from tests.safety.healthy import SLOW
from tests.support import DEADLINE_S

Row = tuple[Inputs, Outputs, Sent]
EPOCH_NS = 1_700_000_000_000_000_000


def config_json() -> str:
    """Return the effective configuration of a real mission."""
    return load_flight("configs/missions/catch.yaml").model_dump_json()


def flight_of(result: FastResult) -> Iterator[Row]:
    """Yield the rows of a flight of the fast loop, with plausible times because it has no wires."""
    for i, o in zip(result.inputs, result.outputs, strict=True):
        sent = sent_at(i.tick, i.t_s)
        yield i, o, replace(sent, attitude_sent=o.attitude is not None, arm_torque_sent_nm=o.arm_torque_nm)


def tethered(end_s: float) -> Iterator[Row]:
    """Yield the synthetic flight up to a mission time, with a tether that becomes nearly taut."""
    for inputs, outputs, sent in synthetic_flight(end_s=end_s):
        slack_m = 0.8 + 0.7 * math.cos(outputs.mission_t_s)
        state = replace(SLOW, range_m=3.0 - slack_m, slack_m=slack_m, stop_slack_m=slack_m - 0.05, taut=slack_m < 0.15)
        yield inputs, replace(outputs, tether=state), sent


def started(path: Path, config: str) -> RecorderProcess:
    """Start a recorder."""
    return RecorderProcess.start(path, config_json=config, epoch_offset_ns=EPOCH_NS, deadline_s=DEADLINE_S)


def offer(recorder: RecorderProcess, rows: Iterable[Row]) -> int:
    """Send ticks, each as soon as the channel has room: faster than real time it would drop some, as in flight."""
    count = 0
    for row in rows:
        select.select([], [recorder.client], [], DEADLINE_S)
        recorder.client.record(*row)
        count += 1
    return count


def record(path: Path, rows: Iterable[Row], *, config_json: str, plan_json: str | None = None) -> Path:
    """Write a whole flight through the real recorder process."""
    recorder = started(path, config_json)
    if plan_json is not None:
        recorder.client.metadata("plan", {"json": plan_json, "mission_s": "20.0"})
    count = offer(recorder, rows)
    report = recorder.finish(DEADLINE_S)
    assert (report.samples, report.dropped, report.error) == (count, 0, None)
    return path
