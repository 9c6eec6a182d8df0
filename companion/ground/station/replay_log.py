"""A flight's log for replay on the page: the messages that the vehicle would have published, 20 per second."""

from __future__ import annotations

import gzip
import json
from dataclasses import dataclass
from pathlib import Path

from companion.analysis.log import FlightLog, LogError, writer
from companion.config.ground import topic_name
from companion.config.loader import FlightConfig
from companion.ground.protocol.messages import VERSION, Preflight, PreflightRow, Presence, State
from companion.ground.telemetry.scene import PATH_POINTS_MAX, scene_of
from companion.ground.telemetry.stream import replay
from companion.model.codec import to_json
from companion.model.types import Vec3

STREAMS_MAX = 12_000
"""Maximum number of stream messages: ten minutes at 20 Hz; longer logs are shown at a lower rate."""
TICKS_MAX = 60_000
_GZIP_LEVEL = 5


@dataclass(frozen=True, slots=True)
class ReplayLog:
    """One log, ready to be sent to the page."""

    name: str
    """Path as the user wrote it; unique among the logs of one page."""
    gzip_json: bytes
    """``{"state", "scene", "preflight", "events", "streams": [...]}``: records of `companion.ground.protocol.messages`."""


def read_for_page(path: Path, number: int) -> ReplayLog:
    """Read a log and convert it for the page.

    Args:
        number: index of this log on the page.

    Raises:
        LogError: one line: the log is missing, damaged, not that of a flight, or of a different version.
    """
    log = FlightLog.read(path, ticks_max=TICKS_MAX)
    if not log.inputs:
        raise LogError(f"{path}: {log.end_missing or 'has no ticks'}")
    config = log.flight_config()
    session = f"log-{number}"
    streams, events = replay(log.rows(), config, session, 1e-9 * log.epoch_offset_ns, max_records=STREAMS_MAX)
    parts = {
        "state": _state(log, config, session),
        "scene": scene_of(config, session, _reference_path(log), mission_s=log.outputs[-1].mission_t_s),
        "preflight": Preflight(VERSION, session, _preflight(log)),
        "events": events,
        "streams": list(streams),
    }
    body = gzip.compress(to_json(parts), _GZIP_LEVEL, mtime=0)
    return ReplayLog(str(path), body)


def _reference_path(log: FlightLog) -> list[Vec3]:
    """Return the reference path at equal time steps, with about as many points as a scene holds."""
    path = [outputs.reference.position_world_m for outputs in log.outputs if outputs.reference is not None]
    return path[:: max(1, len(path) // PATH_POINTS_MAX)]


def _preflight(log: FlightLog) -> tuple[PreflightRow, ...]:
    try:
        rows = json.loads(log.metadata.get("preflight", {}).get("json", "[]"))
        return tuple(PreflightRow(str(row["id"]), str(row["level"]), str(row["text"])) for row in rows)
    except (ValueError, KeyError, TypeError, RecursionError):
        return ()


def _state(log: FlightLog, config: FlightConfig, session: str) -> State:
    flight = log.metadata.get("flight", {})
    return State(
        v=VERSION,
        vehicle=topic_name(config.vehicle.ground.topic, config.vehicle.name),
        session=session,
        presence=Presence.ENDED,
        simulated=flight.get("simulated") == "true",
        mission=config.mission.name,
        law=config.controller.law,
        preset=config.controller.preset,
        wall_s=1e-9 * log.epoch_offset_ns + log.inputs[-1].t_s,
        commands=False,
        outcome=None if log.outcome is None else log.outcome.value,
        text=f"{log.path}, {writer(log.metadata)}" + ("" if log.end_missing is None else f"; {log.end_missing}"),
    )
