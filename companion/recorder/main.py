"""The recorder process: reads ticks from the flight's channel and writes an MCAP log; it outlives the flight process to close the log.

If the vehicle file names a broker the recorder also holds the telemetry session: telemetry out, signed commands in
(`companion.recorder.telemetry`). If it names an address for Foxglove, live viewers may connect (`companion.recorder.live_viewers`).

Channels at full rate, JSON with JSON Schema: ``/inputs``, ``/outputs``, ``/sent``; typed channels at a lower rate, for viewers:
`companion.recorder.viewer_channels`. Metadata records: ``companion`` (log format, epoch offset, versions), ``config`` (effective
configuration as JSON), ``flight``, ``plan``, ``preflight`` (from the flight process) and at the end ``recorder`` (counts).

Every chunk of the file holds whole ticks and is appended in one piece: the file is readable up to its last chunk even if this
process is killed.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import socket
import sys
import time
from pathlib import Path
from typing import Any

from companion.model.codec import RecordError, fingerprint
from companion.model.outputs import Outputs, Sent
from companion.model.packets import Close, CommandAnswer, LogLine, Metadata, Tick, read_packet
from companion.model.types import Inputs
from companion.recorder.channel import FLUSH_PERIOD_S, Channel
from companion.recorder.log_file import LogFile
from companion.recorder.log_writer import LogWriter
from companion.recorder.telemetry import TelemetryThread, broker_configured
from companion.recorder.versions import versions
from companion.runtime.compiled import COMPILED
from companion.runtime.cores import keep_off

LOG_FORMAT = "1"
SYNC_PERIOD_S = 1.0
TELEMETRY_END_TIMEOUT_S = 1.5
"""Timeout for sending the last telemetry messages after the log is closed."""
VIEWERS_END_TIMEOUT_S = 0.3
"""Timeout for sending the last messages to live viewers after the log is closed."""


class Recorder:
    """Runs the main loop: writes packets, flushes chunks, counts losses."""

    def __init__(self, channel: Channel, writer: LogWriter, log_file: LogFile) -> None:
        self._channel = channel
        self._writer = writer
        self._log_file = log_file
        self.telemetry: TelemetryThread | None = None
        self._expected = 0
        self._error_reported = False
        self._in_chunk = 0
        self._closed = False
        self.samples = 0
        self.dropped = 0
        self.error: str | None = None

    def run(self) -> None:
        """Run until a `Close` packet arrives, or the last process that holds the channel ends."""
        flushed_s = synced_s = time.monotonic()
        for packet in self._channel.packets():
            if packet is not None:
                self._handle(packet)
                if self._closed:
                    self._channel.stop()  # the guardian may keep the other end open a little longer
                    break
            now_s = time.monotonic()
            if now_s - flushed_s >= FLUSH_PERIOD_S or self._writer.chunk_is_full:
                flushed_s = now_s
                self._flush()
            if now_s - synced_s >= SYNC_PERIOD_S:
                synced_s = now_s
                self._log_file.sync()
        self._flush()
        if self.telemetry is not None:
            self.telemetry.end(normally=self._closed)
        if self._log_file.error is None:
            counts = self.telemetry.counts if self.telemetry is not None else {}
            self._writer.metadata("recorder", {"samples": str(self.samples), "dropped": str(self.dropped), **counts})
        self._writer.close()
        self._flush()

    def state(self) -> tuple[int, str | None]:
        """Return the number of lost records, and why recording stopped (or None). Called from another thread."""
        return self.dropped, self.error

    def _handle(self, data: bytes) -> None:
        try:
            packet = read_packet(data)
        except RecordError as error:  # the number of the next packet shows that this one is missing
            self.error = self.error or f"recorder: packet {self._expected} could not be written: {error}"
            return
        if packet.number is not None:
            self.dropped += packet.number - self._expected
            self._expected = packet.number + (not isinstance(packet, Close))
        self._closed = isinstance(packet, Close)
        if self._log_file.error is not None:
            self.dropped += not self._closed
            return
        try:
            match packet:
                case Tick():
                    self._writer.tick(packet.inputs, packet.outputs, packet.sent)
                    self._in_chunk += 1
                case LogLine():
                    self._writer.text(packet.t_s, packet.severity.value, packet.source, packet.text)
                case Metadata():
                    self._writer.metadata(packet.name, packet.values)
                case CommandAnswer():
                    severity = "info" if packet.accepted else "warning"
                    text = f"{packet.command.value} of {packet.operator}: {packet.text} ({packet.nonce})"
                    self._writer.text(packet.t_s, severity, "ground", text)
        except (ValueError, TypeError, LookupError, OverflowError, RuntimeError) as error:
            self.dropped += 1
            what = f"packet {packet.number} could not be written: {type(error).__name__}: {error}"
            self.error = self.error or f"recorder: {what}"

    def _flush(self) -> None:
        """Close the chunk; only ticks that reached the disk count as recorded."""
        self._writer.flush()
        self._log_file.commit()
        if self._log_file.error is None:
            self.samples += self._in_chunk
        else:
            self.dropped += self._in_chunk
            if not self._error_reported:
                self._error_reported = True
                self.error = self._log_file.error
                print(self.error, file=sys.stderr, flush=True)
                self._channel.send({"error": self.error})
        self._in_chunk = 0


def _read_config(source: str) -> str:
    """Return the text of a file, or of an open file descriptor given by its number."""
    with open(int(source) if source.isdecimal() else source, encoding="utf-8") as file:
        return file.read()


def _lower_priority(config_json: str) -> None:
    """Give the control tick precedence: leave its cores, and drop its real-time priority."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with contextlib.suppress(OSError):
        os.nice(5)
    with contextlib.suppress(ValueError, LookupError, TypeError):  # a configuration without cores
        keep_off(json.loads(config_json)["vehicle"]["computer"]["cpus"])


def _serve_viewers(writer: LogWriter, config_json: str) -> None:
    """Start the Foxglove server if the configuration has one; without it the flight goes on, with a line in the log."""
    try:
        address = json.loads(config_json)["vehicle"]["ground"]["foxglove"]
    except (ValueError, LookupError, TypeError):  # a configuration without ground stations
        return
    if address is None:
        return
    from companion.config.ground import listen_address  # loads pydantic, which other flights' recorders do without

    try:
        writer.serve(listen_address(address))
    except (ValueError, TypeError, RuntimeError) as error:
        text = f"no live viewers at {address}: {error}"
        writer.text(0.0, "warning", "foxglove", text)
        print(f"recorder: {text}", file=sys.stderr, flush=True)


def _print_json(answer: dict[str, Any]) -> None:
    """Write one JSON line for the parent process, if it still exists."""
    with contextlib.suppress(OSError):
        os.write(1, json.dumps(answer).encode() + b"\n")


def _arguments(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="companion.recorder.main", description="Writes the flight log.")
    parser.add_argument("--fd", type=int, required=True, help="the flight's channel: an open SOCK_SEQPACKET socket")
    parser.add_argument("--out", type=Path, required=True, help="log to write; must not exist")
    parser.add_argument("--config", required=True, help="effective configuration (JSON): a file or an open descriptor")
    parser.add_argument("--epoch-offset-ns", type=int, required=True, help="wall clock when the flight clock was zero")
    parser.add_argument(
        "--metadata", type=json.loads, default={}, help="metadata record `flight`: a JSON object of strings"
    )
    parser.add_argument("--simulated", action="store_true", help="the devices are simulated")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> int:
    """Run until the channel ends; print {"ready": true} first and the report last. Return 1 if the log is incomplete, else 0."""
    for number in (signal.SIGINT, signal.SIGHUP):  # a flight that is killed while this process is stopped hangs it up
        signal.signal(number, signal.SIG_IGN)
    arguments = _arguments(argv)
    try:
        config_json = _read_config(arguments.config)
        _lower_priority(config_json)
        log_file = LogFile(arguments.out)
    except FileExistsError:
        _print_json(
            {"samples": 0, "dropped": 0, "error": f"recorder: {arguments.out} already exists; choose another --out"}
        )
        return 1
    except OSError as error:
        name = error.filename if isinstance(error.filename, str) else arguments.out
        _print_json(
            {"samples": 0, "dropped": 0, "error": f"recorder: {name}: {error.strerror}; choose a writable --out"}
        )
        return 1
    writer = LogWriter(log_file, arguments.epoch_offset_ns)
    about = {
        "log_format": LOG_FORMAT,
        "records": fingerprint(Inputs, Outputs, Sent),
        "epoch_offset_ns": str(arguments.epoch_offset_ns),
        "compiled": json.dumps(COMPILED),
    }
    writer.metadata("companion", {**about, **{f"version_{name}": text for name, text in versions().items()}})
    writer.metadata("config", {"json": config_json})
    writer.metadata("flight", arguments.metadata)
    writer.flush()
    log_file.commit()
    _serve_viewers(writer, config_json)
    with socket.socket(fileno=arguments.fd) as flight:
        channel = Channel(flight)
        signal.signal(signal.SIGTERM, lambda *_: channel.stop())
        recorder = Recorder(channel, writer, log_file)
        telemetry: TelemetryThread | None = None
        if broker_configured(config_json):
            telemetry = recorder.telemetry = TelemetryThread(
                config_json, simulated=arguments.simulated, flight=channel, recorder_state=recorder.state
            )
            channel.copy_to = telemetry.offer
            telemetry.start()
        channel.start()
        _print_json({"ready": True})
        recorder.run()
    log_file.close()
    _print_json({"samples": recorder.samples, "dropped": recorder.dropped, "error": recorder.error})
    code = 0 if recorder.error is None else 1
    viewers_gone = writer.stop_serving(VIEWERS_END_TIMEOUT_S)
    if not viewers_gone or (telemetry is not None and not telemetry.join(TELEMETRY_END_TIMEOUT_S)):
        os._exit(code)  # a thread that waits for an unreachable broker or a dead viewer would delay the exit
    return code


if __name__ == "__main__":
    sys.exit(main())
