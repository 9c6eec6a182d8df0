"""The recorder process: reads ticks from the flight's channel and writes an MCAP log; outlives the flight to close the log.

Channels at full rate, JSON with JSON Schema: ``/inputs``, ``/outputs``, ``/sent``. For viewers, typed and thinned out: ``/tf``,
``/reference``, ``/log``. Metadata records: ``companion`` (log format, epoch offset, versions), ``config`` (effective configuration as
JSON), ``flight`` (given by the caller) and at the end ``recorder`` (counts).

Every chunk of the file holds whole ticks and is appended in one piece: the file can be read up to its last moment even when this
process is killed.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.metadata
import json
import os
import platform
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import foxglove
from foxglove.channels import FrameTransformChannel, LogChannel, PoseInFrameChannel
from foxglove.mcap import MCAPWriteOptions
from foxglove.messages import FrameTransform, Log, LogLevel, Pose, PoseInFrame, Quaternion, Timestamp, Vector3

from companion import __version__
from companion.frames import quat_from_euler_zyx
from companion.io.packets import CLOSE, METADATA, TEXT, TICK, UNNUMBERED
from companion.record import fingerprint, json_schema, json_text, jsonable_from_plain, unpack_plain
from companion.types import Inputs, Outputs, Sent

LOG_FORMAT = "1"
FLUSH_PERIOD_S = 0.4
"""A chunk is closed so often: what a recorder that is killed itself loses. Not much more often: the writer keeps 180 bytes of each
for the index at the end of the file, and with chunks of 16 kB it grew by 30 MB in an hour.
"""
SYNC_PERIOD_S = 1.0
VIEWER_PERIOD_S = 0.02
_QUEUE_PACKETS = 8192
_RECEIVE_BYTES = 2**20
_LEVELS = {"info": LogLevel.Info, "warning": LogLevel.Warning, "critical": LogLevel.Error}
_PACKAGES = ("mavsdk", "pymavlink", "dynamixel-sdk", "pyserial", "numpy", "pydantic", "foxglove-sdk", "mcap", "mujoco")


class Disk:
    """The log file under the MCAP writer: appends whole pieces, and after the first failure swallows everything.

    On a failure the file is cut back to where it was whole the last time (`commit`), so that it stays readable.
    """

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._path = path
        self._whole_bytes = 0
        self._told_bytes = 0
        self.error: str | None = None

    def write(self, data: bytes | bytearray) -> int:
        """Append all of it, or note the error; says that it is written either way."""
        self._told_bytes += len(data)
        if self.error is None:
            rest = memoryview(data)
            try:
                while rest:
                    rest = rest[os.write(self._fd, rest) :]
            except OSError as error:
                self._fail(error)
        return len(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Only tells the position: the writer is asked not to seek."""
        if (offset, whence) not in ((0, os.SEEK_CUR), (self._told_bytes, os.SEEK_SET)):
            raise OSError(f"cannot seek to {offset} ({whence})")
        return self._told_bytes

    def flush(self) -> None:
        """Nothing is buffered here."""

    def commit(self) -> None:
        """What is written so far is a whole log."""
        if self.error is None:
            self._whole_bytes = self._told_bytes

    def sync(self) -> None:
        """Bring what is written onto the medium: a fallen vehicle may lose its power."""
        if self.error is None:
            try:
                os.fdatasync(self._fd)
            except OSError as error:
                self._fail(error)

    def close(self) -> None:
        """Close the file."""
        self.sync()
        os.close(self._fd)

    def _fail(self, error: OSError) -> None:
        self.error = f"recorder: {self._path}: {error.strerror}; the log ends here, the flight goes on without it"
        with contextlib.suppress(OSError):
            os.ftruncate(self._fd, self._whole_bytes)


class LogWriter:
    """Turns packets into messages of one MCAP file."""

    def __init__(self, disk: Disk, epoch_offset_ns: int, *, chunk_bytes: int) -> None:
        self._epoch_offset_ns = epoch_offset_ns
        self._context = foxglove.Context()
        # Chunks are closed by `flush`, between ticks and not within one.
        options = MCAPWriteOptions(profile="companion", chunk_size=None, disable_seeking=True, compression_threads=0)
        self._chunk_bytes = chunk_bytes
        self._mcap = foxglove.open_mcap(disk, context=self._context, writer_options=options)
        self._inputs = self._json_channel("/inputs", Inputs)
        self._outputs = self._json_channel("/outputs", Outputs)
        self._sent = self._json_channel("/sent", Sent)
        self._tf = FrameTransformChannel("/tf", context=self._context)
        self._reference = PoseInFrameChannel("/reference", context=self._context)
        self._log = LogChannel("/log", context=self._context)
        self._viewer_due_s = -1.0e9
        self._unflushed_bytes = 0

    @property
    def chunk_is_full(self) -> bool:
        """Time to flush."""
        return self._unflushed_bytes >= self._chunk_bytes

    def tick(self, inputs_plain: Any, outputs_plain: Any, sent_plain: Any) -> None:
        """One tick: three full-rate messages, its events, and now and then the viewers' messages."""
        inputs = jsonable_from_plain(Inputs, inputs_plain)
        outputs = jsonable_from_plain(Outputs, outputs_plain)
        sent = jsonable_from_plain(Sent, sent_plain)
        # All texts first: a record that cannot be written leaves no half tick behind.
        texts = [json_text(record).encode() for record in (inputs, outputs, sent)]
        stamp_ns = self._stamp_ns(inputs["t_s"])
        for channel, text in zip((self._inputs, self._outputs, self._sent), texts, strict=True):
            channel.log(text, log_time=stamp_ns)
            self._unflushed_bytes += len(text)
        for event in outputs["events"]:
            self.text(event["t_s"], event["severity"], event["id"], event["text"])
        if not 0.0 <= inputs["t_s"] - self._viewer_due_s < VIEWER_PERIOD_S:
            self._viewer_due_s = inputs["t_s"]
            self._viewers(stamp_ns, inputs, outputs)

    def text(self, t_s: float, severity: str, source: str, text: str) -> None:
        """One line of the `/log` channel."""
        stamp_ns = self._stamp_ns(t_s)
        level = _LEVELS.get(severity, LogLevel.Unknown)
        self._log.log(Log(timestamp=_timestamp(stamp_ns), level=level, message=text, name=source), log_time=stamp_ns)
        self._unflushed_bytes += len(text) + 1

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """One metadata record."""
        self._mcap.write_metadata(name, values)

    def flush(self) -> None:
        """Write the open chunk, if it holds anything."""
        if self._unflushed_bytes:
            self._unflushed_bytes = 0
            self._mcap.flush()

    def close(self) -> None:
        """Write the summary; the file is complete."""
        self._mcap.close()

    def _json_channel(self, topic: str, cls: type) -> foxglove.Channel:
        return foxglove.Channel(topic, schema=json_schema(cls), context=self._context)

    def _viewers(self, stamp_ns: int, inputs: dict[str, Any], outputs: dict[str, Any]) -> None:
        pose = inputs.get("mocap") or inputs.get("vehicle")
        if pose is not None:
            transform = FrameTransform(
                timestamp=_timestamp(stamp_ns),
                parent_frame_id="world",
                child_frame_id="body",
                translation=_vector(pose["position_world_m"]),
                rotation=_quaternion(pose["attitude_wxyz"]),
            )
            self._tf.log(transform, log_time=stamp_ns)
        reference = outputs.get("reference")
        if reference is not None:
            where = Pose(
                position=_vector(reference["position_world_m"]),
                orientation=_quaternion(quat_from_euler_zyx(0.0, 0.0, reference["yaw_rad"])),
            )
            self._reference.log(
                PoseInFrame(timestamp=_timestamp(stamp_ns), frame_id="world", pose=where), log_time=stamp_ns
            )

    def _stamp_ns(self, t_s: float) -> int:
        try:
            return max(0, self._epoch_offset_ns + round(t_s * 1e9))
        except (ValueError, OverflowError):  # not finite: a sick tick is worth recording too
            return max(0, self._epoch_offset_ns)


def _timestamp(stamp_ns: int) -> Timestamp:
    return Timestamp(stamp_ns // 1_000_000_000, stamp_ns % 1_000_000_000)


def _vector(xyz: Any) -> Vector3:
    return Vector3(x=xyz[0], y=xyz[1], z=xyz[2])


def _quaternion(wxyz: Any) -> Quaternion:
    return Quaternion(w=wxyz[0], x=wxyz[1], y=wxyz[2], z=wxyz[3])


def versions() -> dict[str, str]:
    """Versions of everything that has a say in what the flight does."""
    found = {"companion": __version__, "python": platform.python_version(), "platform": platform.platform()}
    for package in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    revision = _git_revision()
    return found if revision is None else {**found, "git": revision}


def _git_revision() -> str | None:
    """Commit of the working copy that this module is in, with `-dirty`; None outside of one."""
    root = Path(__file__).resolve().parents[1]
    if not (root / ".git").exists():
        return None
    try:
        done = subprocess.run(
            ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
            capture_output=True,
            text=True,
            timeout=5.0,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None


class _Channel:
    """Reads the flight's packets in a thread of its own, so that a slow disk does not fill the socket."""

    def __init__(self, channel: socket.socket) -> None:
        self._socket = channel
        self._packets: queue.Queue[bytes | None] = queue.Queue(_QUEUE_PACKETS)
        self._thread = threading.Thread(target=self._read, name="channel", daemon=True)
        self._thread.start()

    def packets(self) -> Iterator[bytes | None]:
        """Packets in order; None when none came for a flush period; ends with the channel."""
        while True:
            try:
                packet = self._packets.get(timeout=FLUSH_PERIOD_S)
            except queue.Empty:
                yield None
                continue
            if packet is None:
                return
            yield packet

    def stop(self) -> None:
        """Read what the socket still holds and end."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RD)

    def tell(self, error: str) -> None:
        """Let the flight know; never waits."""
        with contextlib.suppress(OSError):
            self._socket.send(json.dumps({"error": error}).encode(), socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)

    def _read(self) -> None:
        while True:
            try:
                packet = self._socket.recv(_RECEIVE_BYTES)
            except ConnectionResetError:
                continue  # the flight died with a word of ours unread; its packets are still there
            except OSError:
                packet = b""
            self._packets.put(packet or None)
            if not packet:
                return


class Recorder:
    """The loop: packets to messages, flushes, counts."""

    def __init__(self, channel: _Channel, writer: LogWriter, disk: Disk) -> None:
        self._channel = channel
        self._writer = writer
        self._disk = disk
        self._expected = 0
        self._told = False
        self._in_chunk = 0
        self._closed = False
        self.samples = 0
        self.dropped = 0
        self.error: str | None = None

    def run(self) -> None:
        """Until the channel is said to be closed, or ends with the last process that holds it."""
        flushed_s = synced_s = time.monotonic()
        for packet in self._channel.packets():
            if packet is not None:
                self._take(packet)
                if self._closed:
                    self._channel.stop()  # the guardian may hold the other end a little longer
                    break
            now_s = time.monotonic()
            if now_s - flushed_s >= FLUSH_PERIOD_S or self._writer.chunk_is_full:
                flushed_s = now_s
                self._flush()
            if now_s - synced_s >= SYNC_PERIOD_S:
                synced_s = now_s
                self._disk.sync()
        self._flush()
        if self._disk.error is None:
            self._writer.metadata("recorder", {"samples": str(self.samples), "dropped": str(self.dropped)})
        self._writer.close()
        self._flush()

    def _take(self, packet: bytes) -> None:
        kind, number, *rest = unpack_plain(packet)
        if number != UNNUMBERED:
            self.dropped += number - self._expected
            self._expected = number + (kind != CLOSE)
        self._closed = kind == CLOSE
        if self._disk.error is not None:
            self.dropped += kind != CLOSE
            return
        try:
            if kind == TICK:
                self._writer.tick(*rest)
                self._in_chunk += 1
            elif kind == TEXT:
                self._writer.text(*rest)
            elif kind == METADATA:
                self._writer.metadata(*rest)
        except (ValueError, TypeError, LookupError, OverflowError, RuntimeError) as error:
            self.dropped += 1
            self.error = (
                self.error or f"recorder: packet {number} could not be written: {type(error).__name__}: {error}"
            )

    def _flush(self) -> None:
        """Close the chunk; only what the disk took counts as recorded."""
        self._writer.flush()
        self._disk.commit()
        if self._disk.error is None:
            self.samples += self._in_chunk
        else:
            self.dropped += self._in_chunk
            if not self._told:
                self._told = True
                self.error = self._disk.error
                print(self.error, file=sys.stderr, flush=True)
                self._channel.tell(self.error)
        self._in_chunk = 0


def _read_config(source: str) -> str:
    """Text of a file, or of an open file descriptor given by its number."""
    with open(int(source) if source.isdecimal() else source, encoding="utf-8") as file:
        return file.read()


def _yield_to_flight() -> None:
    """The control tick has the first claim on the processor, and its real-time priority is not ours."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with contextlib.suppress(OSError):
        os.nice(5)


def _say(answer: dict[str, Any]) -> None:
    """One JSON line for whoever started us, if it is still there."""
    with contextlib.suppress(OSError):
        os.write(1, json.dumps(answer).encode() + b"\n")


def _arguments(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="companion.recorder_process", description="Writes the flight log.")
    parser.add_argument("--fd", type=int, required=True, help="the flight's channel: an open SOCK_SEQPACKET socket")
    parser.add_argument("--out", type=Path, required=True, help="log to write; must not exist")
    parser.add_argument("--config", required=True, help="effective configuration (JSON): a file or an open descriptor")
    parser.add_argument("--epoch-offset-ns", type=int, required=True, help="wall clock at zero of the flight clock")
    parser.add_argument("--metadata", type=json.loads, default={}, help="JSON object of strings")
    parser.add_argument("--chunk-bytes", type=int, default=2**19, help="largest size of an MCAP chunk")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> int:
    """Run until the channel ends. First line on stdout: {"ready": true}; last line: the report. 0, or 1 if the log is not whole."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    arguments = _arguments(argv)
    _yield_to_flight()
    try:
        config_json = _read_config(arguments.config)
        disk = Disk(arguments.out)
    except FileExistsError:
        _say({"samples": 0, "dropped": 0, "error": f"recorder: {arguments.out} exists already; choose another --out"})
        return 1
    except OSError as error:
        name = error.filename if isinstance(error.filename, str) else arguments.out
        _say({"samples": 0, "dropped": 0, "error": f"recorder: {name}: {error.strerror}; choose a writable --out"})
        return 1
    writer = LogWriter(disk, arguments.epoch_offset_ns, chunk_bytes=arguments.chunk_bytes)
    about = {
        "log_format": LOG_FORMAT,
        "records": fingerprint(Inputs, Outputs, Sent),
        "epoch_offset_ns": str(arguments.epoch_offset_ns),
    }
    writer.metadata("companion", {**about, **{f"version_{name}": text for name, text in versions().items()}})
    writer.metadata("config", {"json": config_json})
    writer.metadata("flight", arguments.metadata)
    writer.flush()
    disk.commit()
    with socket.socket(fileno=arguments.fd) as flight:
        channel = _Channel(flight)
        signal.signal(signal.SIGTERM, lambda *_: channel.stop())
        recorder = Recorder(channel, writer, disk)
        _say({"ready": True})
        recorder.run()
    disk.close()
    _say({"samples": recorder.samples, "dropped": recorder.dropped, "error": recorder.error})
    return 0 if recorder.error is None else 1


if __name__ == "__main__":
    sys.exit(main())
