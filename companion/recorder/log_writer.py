"""Writes the flight process's packets as messages of one MCAP file.

Channels at full rate, JSON with JSON Schema: ``/inputs``, ``/outputs``, ``/sent``; ``/events`` with one message per event. Typed
channels at a lower rate, for viewers: those of `companion.recorder.viewer_channels`, and ``/log``. Every message carries the wall
clock of its tick as log time, publish time and header stamp.
"""

from __future__ import annotations

import json

import foxglove
from foxglove.channels import LogChannel
from foxglove.mcap import MCAPWriteOptions
from foxglove.messages import Log, LogLevel

from companion.ground.protocol.messages import EventLine
from companion.model.codec import Record, json_schema, to_json
from companion.model.outputs import Outputs, Sent
from companion.model.types import Event, Inputs
from companion.recorder.live_viewers import LiveViewers, in_log
from companion.recorder.log_file import LogFile
from companion.recorder.viewer_channels import ViewerChannels, timestamp

LEVELS = {"info": LogLevel.Info, "warning": LogLevel.Warning, "critical": LogLevel.Error}
"""Level of a line of `/log`, by `companion.model.types.Severity`."""
_STAMP_MAX_NS = 2**32 * 1_000_000_000 - 1
"""Largest time stamp of a header, whose seconds have 32 bits."""
_CHUNK_BYTES = 2**19


class LogWriter:
    """Converts packets to messages of one MCAP file.

    Attributes:
        viewer_error: why the viewer messages of a tick were left out, for the first such tick; None if none were left out.
    """

    def __init__(self, log_file: LogFile, epoch_offset_ns: int) -> None:
        self._epoch_offset_ns = epoch_offset_ns
        self._context = foxglove.Context()
        # Chunks are closed by `flush`, between ticks and not within one.
        options = MCAPWriteOptions(profile="companion", chunk_size=None, disable_seeking=True, compression_threads=0)
        self._mcap = foxglove.open_mcap(log_file, context=self._context, channel_filter=in_log, writer_options=options)
        self._records = (
            self._json_channel("/inputs", Inputs),
            self._json_channel("/outputs", Outputs),
            self._json_channel("/sent", Sent),
        )
        self._events = self._json_channel("/events", EventLine)
        self._log = LogChannel("/log", context=self._context)
        self._viewers = ViewerChannels(self._context)
        self._live: LiveViewers | None = None
        self._unflushed_bytes = 0
        self.viewer_error: str | None = None

    def serve(self, address: tuple[str, int]) -> None:
        """Show the flight to live viewers from the next tick on.

        Args:
            address: host and port of this computer for the Foxglove server.

        Raises:
            RuntimeError: the port is in use, or the host is not an address of this computer.
        """
        self._live = LiveViewers(self._context, address, self._records, self._viewers.repeat_static)

    @property
    def chunk_is_full(self) -> bool:
        """Whether the open chunk should be flushed."""
        return self._unflushed_bytes >= _CHUNK_BYTES

    def tick(self, inputs: Inputs, outputs: Outputs, sent: Sent) -> None:
        """Write one tick: three full-rate messages, its events, and the viewer messages that are due."""
        # Encode all records first: one that cannot be encoded must not leave half a tick behind.
        texts = [to_json(record) for record in (inputs, outputs, sent)]
        stamp_ns = self._stamp_ns(inputs.t_s)
        for channel, text in zip(self._records, texts, strict=True):
            channel.log(text, log_time=stamp_ns)
            self._unflushed_bytes += len(text)
        # The tick is recorded: an error in its viewer messages must not count as a lost tick.
        try:
            for event in outputs.events:
                self._event(stamp_ns, outputs.mission_time_s(event), event)
            self._viewers.tick(stamp_ns, inputs, outputs)
            if self._live is not None:
                self._live.tick(inputs.t_s, stamp_ns, texts)
        except (ValueError, TypeError, LookupError, ArithmeticError, RuntimeError) as error:
            if self.viewer_error is None:
                self.viewer_error = f"tick {inputs.tick}: {type(error).__name__}: {error}"
                self._line(stamp_ns, "warning", "recorder", f"viewer messages left out: {self.viewer_error}")

    def text(self, t_s: float, severity: str, source: str, text: str) -> None:
        """Write one line of the `/log` channel."""
        self._line(self._stamp_ns(t_s), severity, source, text)

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """Write one metadata record. The viewer scene is built from `config` and `plan` if they are valid."""
        self._mcap.write_metadata(name, values)
        if name in ("config", "plan"):
            try:
                content = json.loads(values.get("json", "null"))
            except (ValueError, RecursionError):
                content = None
            if name == "config":
                self._viewers.configure(content)
            else:
                self._viewers.plan(content)

    def flush(self) -> None:
        """Write the open chunk if it holds data."""
        if self._unflushed_bytes:
            self._unflushed_bytes = 0
            self._mcap.flush()

    def close(self) -> None:
        """Write the summary, which completes the file."""
        self._mcap.close()

    def stop_serving(self, within_s: float) -> bool:
        """Close the server of live viewers; wait up to `within_s` for it. Return False if it is not closed by then."""
        return self._live is None or self._live.stop(within_s)

    def _json_channel(self, topic: str, cls: type[Record]) -> foxglove.Channel:
        return foxglove.Channel(topic, schema=json_schema(cls), context=self._context)

    def _event(self, stamp_ns: int, mission_t_s: float, event: Event) -> None:
        self._events.log(to_json(EventLine.of(event, mission_t_s)), log_time=stamp_ns)
        self._line(stamp_ns, event.severity.value, event.id, event.text)

    def _line(self, stamp_ns: int, severity: str, source: str, text: str) -> None:
        level = LEVELS.get(severity, LogLevel.Unknown)
        line = Log(timestamp=timestamp(stamp_ns), level=level, message=clean(text), name=clean(source))
        self._log.log(line, log_time=stamp_ns)
        self._unflushed_bytes += len(text) + 1

    def _stamp_ns(self, t_s: float) -> int:
        try:
            stamp_ns = self._epoch_offset_ns + round(t_s * 1e9)
        except (ValueError, OverflowError):  # not finite: record the tick all the same
            stamp_ns = self._epoch_offset_ns
        return min(max(0, stamp_ns), _STAMP_MAX_NS)


def clean(text: str) -> str:
    """Return text that UTF-8 can encode: text from a device may contain lone surrogates."""
    return text.encode("utf-8", "replace").decode()
