"""What the flight process does between opening the devices and the first tick: run the preflight and read PX4 parameters."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from companion.config.loader import FlightConfig
from companion.io.devices import Devices
from companion.io.protocols import Autopilot, DeviceError
from companion.mission.plan import Plan
from companion.model.check_row import Row, refusals
from companion.model.launcher_messages import PreflightDone, PreflightProgress
from companion.model.observations import Observations
from companion.model.types import Vec3
from companion.preflight import run as preflight
from companion.preflight.px4 import text_of
from companion.px4.required import HOVER
from companion.recorder.client import RecorderClient
from companion.runtime import ipc
from companion.runtime.clock import Clock

PATH_POINTS_MAX = 300


class Refused(Exception):
    """The preflight refuses the flight; each of `lines` is a reason."""

    def __init__(self, lines: list[str]) -> None:
        super().__init__("; ".join(lines))
        self.lines = lines


@dataclass(frozen=True, slots=True)
class Checked:
    """Results of the preflight that the flight uses."""

    plan: Plan
    """Plan from the mission's start pose."""
    rows: tuple[Row, ...]
    params: Mapping[str, float | int]
    """Values of PX4's parameters by name."""

    def log_to(self, recorder: RecorderClient) -> None:
        """Send the planned path and the preflight to the log and the ground stations."""
        path = [[round(value, 4) for value in point] for point in path_of(self.plan)]
        recorder.metadata("plan", {"json": json.dumps(path), "mission_s": repr(self.plan.duration_s)})
        rows = [{"id": row.id, "level": "ok" if row.ok else row.level.value, "text": row.line()} for row in self.rows]
        recorder.metadata("preflight", {"json": json.dumps(rows)})


def path_of(plan: Plan) -> list[Vec3]:
    """Return `PATH_POINTS_MAX` planned positions, world frame, m, evenly spaced in time from the plan's start to its end."""
    steps = PATH_POINTS_MAX - 1
    return [plan.reference(plan.duration_s * step / steps).position_world_m for step in range(PATH_POINTS_MAX)]


async def check_before_flight(
    devices: Devices, config: FlightConfig, clock: Clock, out: Path, channel: socket.socket, sitl: bool
) -> Checked:
    """Run the preflight, report it to the launcher and write `preflight.json`.

    Raises:
        DeviceError: `preflight.json` cannot be written.
        Refused: a check refuses the flight.
    """

    def report(text: str, share: float) -> None:
        ipc.send(channel, PreflightProgress(text, share))

    # A path takes seconds to plan, once in a process: here, while motion capture keeps flowing.
    plan = await asyncio.to_thread(Plan.build, config.mission, config.vehicle)
    known = Observations(start_s=0.0, duration_s=0.0, mission_s=plan.duration_s)
    rows, params = await preflight.preflight(devices, config, clock, out=out, progress=report, known=known, sitl=sitl)
    ipc.send(channel, PreflightDone(tuple(rows)))
    try:
        preflight.write(rows, out)
    except OSError as error:
        raise DeviceError(
            f"{out / preflight.FILE}: cannot be written: {error.strerror}; choose another --out"
        ) from None
    if refused := refusals(rows):
        raise Refused([row.line() for row in refused])
    return Checked(plan, tuple(rows), params)


async def changed_since(checked: Mapping[str, float | int], autopilot: Autopilot) -> str:
    """Return why a START is refused: the PX4 parameters that no longer have the values of the preflight. Empty if all have them."""
    try:
        now = await autopilot.read_params(checked)
    except DeviceError as error:
        return f"start refused: {error}"
    changed = [
        f"{name} is {text_of(now.get(name))}, was {text_of(value)}"
        for name, value in checked.items()
        if text_of(now.get(name)) != text_of(value)
    ]
    if not changed:
        return ""
    return (
        f"start refused: PX4's parameters have changed since the preflight: {'; '.join(changed)}; set them back, or start companion "
        "again, so that the preflight checks them"
    )


async def with_hover_thrust(config: FlightConfig, autopilot: Autopilot) -> FlightConfig:
    """Return the effective configuration with the hover thrust from PX4 unless the vehicle file gives it.

    Raises:
        DeviceError: the parameter cannot be read or is out of range.
    """
    airframe = config.vehicle.airframe
    if airframe.hover_thrust is not None:
        return config
    value = float(await autopilot.read_param(HOVER))
    if not 0.1 <= value <= 0.8:
        raise DeviceError(
            f"autopilot: {HOVER} = {value:.3f} is not a plausible hover thrust, expected 0.1 to 0.8;"
            f" set it in PX4 or give airframe.hover_thrust"
        )
    airframe = airframe.model_copy(update={"hover_thrust": value})
    vehicle = config.vehicle.model_copy(update={"airframe": airframe})
    return config.model_copy(update={"vehicle": vehicle})
