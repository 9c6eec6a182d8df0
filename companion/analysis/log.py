"""Reads a flight log (MCAP), even an unclosed one, into the records of `companion.model`."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from mcap.exceptions import EndOfFile, InvalidMagic, McapError
from mcap.records import Channel, Footer, Message, Metadata
from mcap.stream_reader import StreamReader
from pydantic import ValidationError
from zstandard import ZstdError

from companion import DISTRIBUTION
from companion.analysis.columns import Columns, array_of, columns_of
from companion.analysis.logged_config import checked_config, checked_path
from companion.analysis.tables import TOPICS, cells_of
from companion.analysis.timing import Array as Array
from companion.analysis.timing import Stopwatch, Timing, timing_of
from companion.config.loader import FlightConfig, logged_flight
from companion.model.arm_skeleton import ArmSkeleton, logged_skeleton
from companion.model.codec import RecordError, from_json
from companion.model.outputs import Outputs, Sent
from companion.model.types import Inputs, Outcome
from companion.plugins import PluginError
from companion.runtime.console import print_error

TICKS_KEPT = 20_000
"""Ticks that commands keep in memory which need every tick: they read a longer log again, tick by tick."""
_RECORDS: dict[str, type] = dict(zip(TOPICS, (Inputs, Outputs, Sent), strict=True))
_TORN = "/inputs, /outputs and /sent hold different ticks"
Row = tuple[Inputs, Outputs, Sent]
"""A tick."""
_FORMER_NAMES = (
    (b'"bent_by"', b'"limited_by"'),
    (b'"mode":"weigh"', b'"mode":"tare"'),
    (b'"id":"reattached"', b'"id":"armed_externally"'),
    (b'"id":"called_off"', b'"id":"takeoff_cancelled"'),
    (b'"id":"arm_let_go"', b'"id":"servo_watchdog_tripped"'),
)
"""Keys and ids of logs of the previous release, and their current names."""


_EPOCH_NS_MAX, _T_S_MAX = 3 * 10**18, 1e9
"""Limits of the wall clock at 0 of the flight clock, ns, and of the flight clock, s. Viewers store the sum's seconds in 32 bits."""


class LogError(Exception):
    """The file is not a flight log, or cannot be used as requested. The text is one line for the user."""


@dataclass(frozen=True)
class FlightLog:
    """A flight: three lists of equal length with one entry per recorded tick, in order. A long flight may be thinned (`stride`)."""

    path: Path
    inputs: tuple[Inputs, ...]
    outputs: tuple[Outputs, ...]
    sent: tuple[Sent, ...]
    metadata: dict[str, dict[str, str]]
    """All metadata records by name: companion, config, flight, recorder, ..."""
    closed: bool
    """Whether the recorder closed the file."""
    stride: int = 1
    """Every `stride`-th tick, every tick with events and the last tick are kept; 1 keeps all."""
    measured: Timing | None = None
    """Timing of all ticks; None if all ticks are kept."""

    @property
    def clock(self) -> str:
        """Return the clock by which the flight ran: `simulated` or `real`. In simulated time its latencies are zero."""
        return self.metadata.get("flight", {}).get("clock", "real")

    @property
    def outcome(self) -> Outcome | None:
        """Return the outcome; None if the log ends before it, as that of a flight whose process was killed."""
        return next((outputs.outcome for outputs in reversed(self.outputs) if outputs.outcome is not None), None)

    @property
    def end_missing(self) -> str | None:
        """Return in one line what the log's end lacks; None if the recorder closed it after the flight's outcome."""
        if not self.inputs:
            return None if self.closed else "the log was not closed and has no ticks"
        last = f"its last whole tick is at t = {self.inputs[-1].t_s:.3f} s"
        if self.outcome is None:
            return f"the log ends before the flight did: {last}, the outcome is not in it"
        return None if self.closed else f"the log was not closed: {last}, the outcome is in it"

    def report_missing_end(self) -> None:
        """Print to standard error what the log's end lacks, if it lacks anything."""
        if self.end_missing is not None:
            print_error(f"{self.path}: {self.end_missing}")

    @staticmethod
    def read(path: Path, *, ticks_max: int | None = None, part: range | None = None) -> FlightLog:
        """Read a log.

        Args:
            part: keep only the ticks of these numbers, and the last one. None keeps all.
            ticks_max: keep about this many ticks, evenly spread (`stride`), those with events, and the last one; a tick takes
                about 9 kB of memory. None keeps all.

        Raises:
            LogError: the file does not exist, is not MCAP, was not written by the recorder, is damaged, has metadata with invalid
                values, or has records whose fields differ from those of this version. An optional field that an older log lacks is
                read as None.
        """
        reading, rows = _Reading(path), _Rows(ticks_max, part)
        for row in reading.ticks():
            rows.take(row)
        kept = rows.with_the_last()
        log = FlightLog(
            path=path,
            inputs=tuple(row[0] for row in kept),
            outputs=tuple(row[1] for row in kept),
            sent=tuple(row[2] for row in kept),
            metadata=reading.metadata,
            closed=reading.closed,
            stride=rows.stride,
            measured=rows.measured,
        )
        log._check()
        return log

    def _check(self) -> None:
        offset = self.metadata["companion"].get("epoch_offset_ns", "0")
        if not re.fullmatch(r"-?[0-9]{1,19}", offset) or abs(int(offset)) > _EPOCH_NS_MAX:
            raise LogError(
                f"{self.path}: metadata 'companion', epoch_offset_ns: got {offset[:40]!r}, expected a time in ns"
            )
        for name, read in (("config", lambda: self.config), ("plan", lambda: self.planned_path)):
            try:
                read()
            except ValueError as error:
                raise LogError(f"{self.path}: metadata '{name}': {error}") from None

    @property
    def epoch_offset_ns(self) -> int:
        """Return the wall-clock time at 0 of the flight clock in ns; 0 if it is unknown."""
        return int(self.metadata["companion"].get("epoch_offset_ns", "0"))

    @property
    def config_json(self) -> str | None:
        """Return the effective configuration as recorded, or None."""
        return self.metadata.get("config", {}).get("json") or None

    def flight_config(self) -> FlightConfig:
        """Return the recorded configuration, checked.

        Raises:
            LogError: the log has none, or one that does not fit this version or the installed packages.
        """
        if self.config_json is None:
            raise LogError(f"{self.path}: has no configuration (metadata record 'config')")
        try:
            return logged_flight(self.config_json)
        except ValidationError as error:
            first = error.errors()[0]
            raise LogError(
                f"{self.path}: its configuration is not compatible with this version ({'.'.join(map(str, first['loc']))}: "
                f"{first['msg']}); it was written by {writer(self.metadata)}"
            ) from None
        except (PluginError, ValueError) as error:
            raise LogError(f"{self.path}: {error}") from None

    @cached_property
    def config(self) -> dict[str, Any]:
        """Return the effective configuration as plain nested data; empty if absent.

        Raises:
            ValueError: it is invalid, which `read` has excluded.
        """
        return checked_config(self.config_json or "{}")

    @property
    def planned_path(self) -> list[list[float]]:
        """Return the points of the planned path, world frame, m; empty if absent."""
        return checked_path(self.metadata.get("plan", {}).get("json") or "[]")

    def missing_ticks(self) -> int:
        """Return the number of ticks between the first and the last one that are not in the log."""
        timing = self.timing
        return timing.last_tick - timing.first_tick + 1 - timing.ticks if timing.ticks else 0

    @cached_property
    def timing(self) -> Timing:
        """Return the timing of every recorded tick, whether kept or not."""
        return self.measured or timing_of(self.rows())

    def rows(self) -> Iterator[Row]:
        """Iterate over the ticks in order."""
        return zip(self.inputs, self.outputs, self.sent, strict=True)

    def every_tick(self) -> Iterator[Row]:
        """Iterate over the ticks in order, those that were thinned out too: a thinned log's file is read again, tick by tick."""
        return self.rows() if self.stride == 1 else _Reading(self.path).ticks()

    @cached_property
    def joint_count(self) -> int:
        """Number of the arm's joints: that of the first reference or joint state, or 0 if the log has neither."""
        for inputs, outputs, _ in self.rows():
            if outputs.reference is not None:
                return len(outputs.reference.arm_rad)
            if inputs.arm is not None:
                return len(inputs.arm.angle_rad)
        return 0

    @cached_property
    def arm_skeleton(self) -> ArmSkeleton | None:
        """Skeleton of arm and tool in the configuration; None if it has no arm or one with another number of joints."""
        skeleton = logged_skeleton(self.config.get("vehicle"))
        return skeleton if skeleton is not None and len(skeleton.joint_axes) == self.joint_count else None

    def column(self, value: Callable[[Inputs, Outputs, Sent], Any], width: int | None = None) -> Array:
        """Return one row per tick: a float (`width` None) or `width` floats; NaN where `value` returns None."""
        return array_of([value(*row) for row in self.rows()], width)

    def to_pandas(self) -> dict[str, Any]:
        """Return a pandas DataFrame for each of `/inputs`, `/outputs`, `/sent` and `/events`, indexed by `t_s` (s, flight clock).

        A column has the name of its field's path, which contains unit and frame; the index of an element is in brackets:
        `mocap.position_world_m[0]`. The value is NaN where a tick lacks the field. `/events` has one row per event, the others have
        one row per tick.

        Raises:
            LogError: pandas is not installed.
        """
        try:
            import pandas
        except ImportError:
            raise LogError(f"to_pandas: needs pandas: pip install '{DISTRIBUTION}[pandas]'") from None
        ticks_s = [inputs.t_s for inputs in self.inputs]
        events = [(event, outputs.mission_time_s(event)) for outputs in self.outputs for event in outputs.events]
        tables = {
            "/inputs": (ticks_s, map(cells_of, self.inputs)),
            "/outputs": (ticks_s, map(cells_of, self.outputs)),
            "/sent": (ticks_s, map(cells_of, self.sent)),
            "/events": (
                [event.t_s for event, _ in events],
                ({**cells_of(event), "mission_t_s": t} for event, t in events),
            ),
        }
        return {
            topic: pandas.DataFrame(list(rows), index=pandas.Index(times_s, name="t_s", dtype=float))
            for topic, (times_s, rows) in tables.items()
        }

    @cached_property
    def columns(self) -> Columns:
        """Return the quantities that metrics and plots share, as arrays."""
        return columns_of(self.rows(), self.joint_count)


class _Reading:
    """One reading of a log's file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.metadata: dict[str, dict[str, str]] = {}
        self.closed = False

    def ticks(self) -> Iterator[Row]:
        """Iterate over the ticks, whose three records a chunk holds whole; raises the errors of `FlightLog.read`."""
        path, metadata = self._path, self.metadata
        channels: dict[int, str] = {}
        row: list[Any] = []
        try:
            for record in _mcap_records(path):
                if isinstance(record, Channel):
                    channels[record.id] = record.topic
                elif isinstance(record, Message):
                    topic = channels[record.channel_id]
                    if topic in _RECORDS:
                        data = record.data
                        for former, name in _FORMER_NAMES:
                            data = data.replace(former, name)
                        part: Any = from_json(_RECORDS[topic], data)
                        if topic != TOPICS[len(row)] or (row and part.tick != row[0].tick):
                            raise ValueError(_TORN)
                        row.append(part)
                        if len(row) == len(TOPICS):
                            inputs, outputs, sent = row
                            row = []
                            for t_s in (inputs.t_s, outputs.t_s):
                                if not abs(t_s) <= _T_S_MAX:
                                    raise ValueError(f"tick {inputs.tick} has the time {t_s} s (limit {_T_S_MAX:g} s)")
                            yield inputs, outputs, sent
                elif isinstance(record, Metadata):
                    metadata[record.name] = dict(record.metadata)
                elif isinstance(record, Footer):
                    self.closed = True
            if row:
                raise ValueError(_TORN)
        except RecordError as error:
            raise LogError(
                f"{path}: its records' fields differ from this version's ({error}); it was written by {writer(metadata)}: "
                "open it with that version"
            ) from None
        except (McapError, ZstdError, RuntimeError, MemoryError, struct.error, ValueError, KeyError) as error:
            raise LogError(f"{path}: damaged: {error or type(error).__name__}") from None
        if "companion" not in metadata:
            what = (
                "an MCAP file, but not a flight log" if self.closed else "not a flight log, or cut off at its beginning"
            )
            raise LogError(f"{path}: {what}: it has no 'companion' metadata record")


class _Rows:
    """Keeps ticks, and thins them out when there are too many."""

    def __init__(self, ticks_max: int | None, part: range | None) -> None:
        self._ticks_max = ticks_max
        self._part = part
        self._stopwatch = Stopwatch() if ticks_max is not None else None
        self._kept: list[Row] = []
        self._spread = 0
        """Number of kept ticks that are kept for their number: only these become fewer when the stride grows."""
        self._last: Row | None = None
        self.stride = 1

    def take(self, row: Row) -> None:
        """Add the next tick of the file."""
        self._last = row
        if self._stopwatch is not None:
            self._stopwatch.take(row[0], row[2])
        self._keep(row)
        if self._ticks_max is not None and self._spread > self._ticks_max:
            self.stride *= 2
            rows, self._kept, self._spread = self._kept, [], 0
            for kept in rows:
                self._keep(kept)

    def with_the_last(self) -> list[Row]:
        """Return the kept ticks and the last one, which has the outcome."""
        if self._last is None or (self._kept and self._kept[-1] is self._last):
            return self._kept
        return [*self._kept, self._last]

    def _keep(self, row: Row) -> None:
        tick, part = row[0].tick, self._part
        spread = tick % self.stride == 0 and (part is None or tick in part)
        if spread or (part is None and row[1].events):
            self._kept.append(row)
            self._spread += spread

    @property
    def measured(self) -> Timing | None:
        """Return the timing of all ticks, or None if all ticks are kept."""
        return self._stopwatch.read() if self._stopwatch is not None and self.stride > 1 else None


def writer(metadata: dict[str, dict[str, str]]) -> str:
    """Return the version and git revision of the companion that wrote a log with this metadata."""
    about = metadata.get("companion", {})
    return f"companion {about.get('version_companion', 'of unknown version')} ({about.get('version_git', 'no git revision')})"


def _mcap_records(path: Path) -> Iterator[Any]:
    """Iterate over the records of the file in order. An unclosed file ends without an error."""
    try:
        file = path.open("rb")
    except IsADirectoryError:
        raise LogError(f"{path}: is a folder; expected a flight log, such as {path / 'flight.mcap'}") from None
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from None
    with file:
        if path.stat().st_size == 0:
            raise LogError(f"{path}: is empty; expected a flight log (MCAP)")
        try:
            yield from StreamReader(file, validate_crcs=True).records
        except InvalidMagic:
            raise LogError(f"{path}: is not an MCAP file; expected a flight log such as flight.mcap") from None
        except (EndOfFile, struct.error):
            if file.read(1):
                raise LogError(f"{path}: damaged before its end") from None
