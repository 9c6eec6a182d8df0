"""One file for Foxglove from the logs of several flights: the viewer channels of each, with its name before topics and frames."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping
from pathlib import Path

import foxglove
from foxglove.channels import LogChannel
from foxglove.mcap import MCAPWriteOptions
from foxglove.messages import Log

from companion.analysis.log import FlightLog
from companion.model.outputs import Outputs
from companion.model.types import Inputs
from companion.recorder.log_file import LogFile
from companion.recorder.log_writer import LEVELS, clean
from companion.recorder.viewer_channels import ViewerChannels, timestamp


def write_viewer_file(logs: Mapping[str, FlightLog], path: Path) -> None:
    """Write the channels of `companion.recorder.viewer_channels` for each log, and ``/log`` with the events of all.

    Flights in simulated time share the clock of their world; all others are placed by the wall clock of their computers.

    Args:
        logs: by name.
        path: file to write; must not exist.

    Raises:
        OSError: the file exists or cannot be written.
    """
    context = foxglove.Context()
    epochs_ns = {name: log.epoch_offset_ns for name, log in logs.items()}
    if all(log.clock == "simulated" for log in logs.values()):
        epochs_ns = dict.fromkeys(logs, max(epochs_ns.values()))
    file = LogFile(path)  # of a full disk the writer says only that a write has failed
    try:
        with foxglove.open_mcap(file, context=context, writer_options=MCAPWriteOptions(disable_seeking=True)):
            _write(context, logs, epochs_ns)
        if file.failure is not None:
            raise file.failure
    except BaseException:
        path.unlink()
        raise
    finally:
        file.close()


def _write(context: foxglove.Context, logs: Mapping[str, FlightLog], epochs_ns: Mapping[str, int]) -> None:
    lines = LogChannel("/log", context=context)
    viewers = {name: ViewerChannels(context, f"{name}/") for name in logs}
    for name, log in logs.items():
        viewers[name].configure(log.config)
        viewers[name].plan(log.planned_path)
    ticks = [_ticks(name, log, epochs_ns[name]) for name, log in logs.items()]
    for stamp_ns, name, inputs, outputs in heapq.merge(*ticks, key=lambda tick: tick[0]):
        viewers[name].tick(stamp_ns, inputs, outputs)
        for event in outputs.events:
            level, stamp = LEVELS[event.severity.value], timestamp(stamp_ns)
            line = Log(timestamp=stamp, level=level, message=clean(event.text), name=f"{name} {event.id}")
            lines.log(line, log_time=stamp_ns)


def _ticks(name: str, log: FlightLog, epoch_ns: int) -> Iterator[tuple[int, str, Inputs, Outputs]]:
    for inputs, outputs, _ in log.every_tick():
        stamp_ns = epoch_ns + round(inputs.t_s * 1e9)
        if stamp_ns >= 0:
            yield stamp_ns, name, inputs, outputs
