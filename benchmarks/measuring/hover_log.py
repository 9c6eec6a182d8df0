"""Reads the ticks of a hover from its log, one chunk at a time."""

from __future__ import annotations

import json
from array import array
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from mcap.reader import make_reader

from companion.analysis.timing import Stopwatch, Timing
from companion.model.codec import from_json
from companion.model.outputs import Sent
from companion.model.types import Inputs

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class HoverLog:
    """The ticks of one phase; times in s."""

    timing: Timing
    start_s: Array
    """Start of each tick on the flight clock."""
    start_to_setpoint_s: Array
    """Time from the start of a tick to its setpoint, for ticks that sent one."""
    epoch_offset_s: float
    """Wall clock at zero of the flight clock."""
    realtime: str | None
    """Real-time settings that the operating system granted, or None if the log has none."""


def read_hover(path: Path, phase: str, settle_s: float) -> HoverLog:
    """Read a log.

    Args:
        path: path of flight.mcap, closed by its recorder.
        phase: name of the phase.
        settle_s: time at its beginning that is left out.

    Raises:
        ValueError: the log has no such phase, or a shorter one.
    """
    stopwatch = Stopwatch()
    start_s, setpoint_s = array("d"), array("d")
    begun_s: float | None = None
    with path.open("rb") as file:
        reader = make_reader(file)
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        inputs: Inputs | None = None
        inside = False
        for _, channel, message in reader.iter_messages(topics=["/inputs", "/outputs", "/sent"], log_time_order=False):
            data = json.loads(message.data)
            if channel.topic == "/outputs":
                inside = data["phase"] == phase
                begun_s = data["t_s"] if inside and begun_s is None else begun_s
            elif channel.topic == "/inputs":
                inputs = from_json(Inputs, message.data)
            elif inside and begun_s is not None and inputs is not None and data["start_s"] >= begun_s + settle_s:
                sent = from_json(Sent, message.data)
                stopwatch.take(inputs, sent)
                start_s.append(sent.start_s)
                if sent.attitude_sent:
                    setpoint_s.append(sent.setpoint_sent_s - sent.start_s)
    if not start_s:
        raise ValueError(f"{path}: no tick of the phase {phase!r} after its first {settle_s:g} s")
    offset_s = int(metadata["companion"]["epoch_offset_ns"]) * 1e-9
    realtime = metadata.get("realtime", {}).get("got")
    return HoverLog(
        timing=stopwatch.read(),
        start_s=np.array(start_s),
        start_to_setpoint_s=np.array(setpoint_s),
        epoch_offset_s=offset_s,
        realtime=realtime,
    )
