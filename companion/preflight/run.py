"""Runs a preflight: observes the devices, evaluates the data and writes the result."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from companion.config.loader import FlightConfig
from companion.io.devices import AvailableDevices, Devices
from companion.model.check_row import Row, refusals
from companion.model.observations import Observations
from companion.preflight import evaluation
from companion.preflight.hand_test import record as hand_record
from companion.preflight.observe import Progress, observe
from companion.runtime import simulated_time
from companion.runtime.clock import Clock
from companion.runtime.compiled import COMPILED
from companion.runtime.realtime import FLIGHT_PRIORITY, claim_realtime

SCHEMA_VERSION = 1
FILE = "preflight.json"


async def preflight(
    devices: Devices | AvailableDevices,
    config: FlightConfig,
    clock: Clock,
    *,
    out: Path,
    progress: Progress,
    known: Observations,
    sitl: bool,
) -> tuple[list[Row], dict[str, float | int]]:
    """Observe the open devices and evaluate the data, with the priority and on the cores of a flight. Return the rows, and the values
    of PX4's parameters that were read.

    Args:
        devices, config, clock, out, progress, known: arguments of `companion.preflight.observe.observe`.
        sitl: whether the devices are simulated; no record of the hand test is then required.
    """
    if not sitl and devices.mocap is not None and devices.mocap.server is not None:
        passed, changed = _hand_test(config, devices.mocap.server.protocol_version)
        known = replace(known, hand_test=passed, hand_test_changed=changed)
    computer = config.vehicle.computer
    if simulated_time.current() is None:
        # As in flight, so that a busy computer is not mistaken for a bad bus or network.
        claim_realtime(FLIGHT_PRIORITY, cpus=computer.cpus, lock_memory=computer.lock_memory)
    seen = await observe(
        devices,
        config,
        clock,
        out=out,
        param_names=evaluation.param_names(config.vehicle),
        unsettled=lambda o: evaluation.unsettled(o, config),
        progress=progress,
        known=known,
    )
    return evaluation.rows(seen, config), dict(seen.params)


def _hand_test(config: FlightConfig, natnet_version: str) -> tuple[str, str]:
    try:
        tests = hand_record.load(hand_record.record_path())
    except hand_record.RecordError as error:
        return "", str(error)
    return hand_record.on_record(hand_record.Setup.of(config.vehicle, natnet_version), tests)


def as_json(rows: Sequence[Row]) -> dict[str, Any]:
    """Return the JSON of `companion check --json` and of `preflight.json`."""
    return {
        "schema_version": SCHEMA_VERSION,
        "ok": not refusals(rows),
        "compiled": COMPILED,
        "rows": [row.as_json() for row in rows],
    }


def write(rows: Sequence[Row], out: Path) -> None:
    """Write `preflight.json` into a flight's folder.

    Raises:
        OSError: the file cannot be written.
    """
    (out / FILE).write_text(json.dumps(as_json(rows), indent=1), encoding="utf-8")
