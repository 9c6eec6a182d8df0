"""Packets of the flight process as messages of one MCAP file.

Channels at full rate, JSON with JSON Schema: ``/inputs``, ``/outputs``, ``/sent``. For viewers, typed and thinned out: ``/tf``,
``/reference``, ``/log``.
"""

from __future__ import annotations

from typing import Any

import foxglove
from foxglove.channels import FrameTransformChannel, LogChannel, PoseInFrameChannel
from foxglove.mcap import MCAPWriteOptions
from foxglove.messages import FrameTransform, Log, LogLevel, Pose, PoseInFrame, Quaternion, Timestamp, Vector3

from companion.frames import quat_from_euler_zyx
from companion.record import json_schema, json_text, jsonable_from_plain
from companion.recording.disk import Disk
from companion.types import Inputs, Outputs, Sent

VIEWER_PERIOD_S = 0.02
_LEVELS = {"info": LogLevel.Info, "warning": LogLevel.Warning, "critical": LogLevel.Error}


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
