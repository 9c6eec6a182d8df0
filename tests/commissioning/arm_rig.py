"""Servos with something wrong about them, a vehicle file of its own, and the arm's tools run against them over a real pty.

Where nothing has to move, the servos lie on a bench: their bus alone, in this process. Else a simulated world holds and moves the arm.
"""

from __future__ import annotations

import asyncio
import json
import select
import shutil
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import AsyncExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from companion.io.devices import AvailableDevices, PoseForwarder
from companion.io.dynamixel.arm import DynamixelArm
from companion.io.dynamixel.port import ServoPort
from companion.io.dynamixel.scale import RAD_PER_COUNT
from companion.io.protocols import DeviceError
from companion.model.check_row import Row
from companion.model.exit_codes import EXIT_OK
from companion.preflight import arm as preflight
from companion.preflight.observe import observe
from companion.runtime.clock import flight_clock
from companion.sitl_config.loader import load_sitl
from sitl.servo.bus import ServoBus
from sitl.servo.from_config import plugged_in, servos_of
from sitl.world.start import start_of
from tests.support import CATCH, ROOT, Ended, Running, Sandbox, World, run_here, sandbox_in

HAND = "world.arm_handling=true"
FILES = "3000000"
"""The shipped vehicle file's baud rate: to look at it alone takes a second."""
SHIPPED = ROOT / "configs/vehicles/tarot650_2r.yaml"
PATIENT = ("vehicle.devices.arm.watchdog_ms=1500", "vehicle.safety.arm_timeout_s=2.0", "vehicle.ground.mqtt=null")
"""A shared machine is held up as a whole now and then, by more than the vehicle file allows."""

OF_THE_COMPUTER = {"arm.reads"}
_LOOK = "vehicle.safety.preflight_s=1.0"
NOISE_MS = 20_000.0
"""A line on which something still arrives after this time is noisy."""


@dataclass(frozen=True)
class Rig:
    """Tools are run on the bus at `port`, by the vehicle file `vehicle`."""

    sandbox: Sandbox
    port: str
    vehicle: Path

    def overrides(self, *more: str) -> list[str]:
        """Of every tool."""
        return [f"vehicle.devices.arm.port={self.port}", *PATIENT, *more]

    def options(self, *overrides: str) -> list[str]:
        """The same on a command line, and the vehicle file."""
        return [
            "--vehicle",
            str(self.vehicle),
            *(word for one in self.overrides(*overrides) for word in ("--set", one)),
        ]

    def start(self, *words: str, background: bool = False) -> Running:
        """`companion arm WORDS` as a process."""
        return self.sandbox.start("arm", *words, *self.options(), background=background)

    def run(self, *words: str) -> Ended:
        """`companion arm WORDS` in this process."""
        return run_here("arm", *words, *self.options())

    def json(self, *words: str, process: bool = False) -> tuple[int, dict[str, Any]]:
        """Exit code and the one document on standard output of `companion arm WORDS --json`, in this process or one of its own."""
        if process:
            ended = self.sandbox.run("arm", *words, "--json", *self.options())
        else:
            ended = self.run(*words, "--json")
        assert ended.out.count("\n") == 1, ended.err
        document: dict[str, Any] = json.loads(ended.out)
        assert document["schema_version"] == 1 and document["ok"] == (ended.code == EXIT_OK)
        return ended.code, document

    def check_rows(self) -> dict[str, Row]:
        """What the preflight finds of the arm, by the vehicle file as it is now."""
        return asyncio.run(self._look())

    async def _look(self) -> dict[str, Row]:
        config = load_sitl(CATCH, self.vehicle, overrides=self.overrides(_LOOK))
        vehicle, clock, edges = config.vehicle, flight_clock(), AvailableDevices(PoseForwarder())
        async with AsyncExitStack() as stack:
            try:
                edges.arm = await stack.enter_async_context(DynamixelArm(vehicle.arm_device, vehicle.arm, clock))
            except DeviceError as error:
                edges.failures["arm"] = str(error)
            seen = await observe(
                edges,
                config,
                clock,
                out=self.sandbox.cwd,
                param_names=(),
                unsettled=lambda _: None,
                progress=lambda _, __: None,
            )
        return {row.id: row for row in preflight.rows(seen, vehicle)}

    def assert_check_passes_the_arm(self) -> None:
        """Everything that the tools can put right. How many bus cycles a busy computer misses is not theirs (`OF_THE_COMPUTER`)."""
        rows = self.check_rows()
        refusing = [row for name, row in rows.items() if name not in OF_THE_COMPUTER and row.refuses]
        assert refusing == [], refusing
        assert {"arm.device", "arm.angles", "arm.mode", "arm.return_delay"} <= set(rows)


@contextmanager
def rig(folder: Path, *overrides: str) -> Iterator[Rig]:
    """A world with these overrides, and a copy of the shipped vehicle file."""
    with (
        sandbox_in(folder / "tool") as sandbox,
        sandbox_in(folder / "world") as around,
        World(around, CATCH, overrides) as world,
    ):
        yield Rig(sandbox, str(world.devices["arm"]["port"]), _copy(folder))


@contextmanager
def bench(folder: Path, servos: str = "[{}, {}]") -> Iterator[Rig]:
    """Servos with `world.servos` as given, in an arm that stands as the mission begins, and a copy of the shipped vehicle file."""
    config = load_sitl(CATCH, overrides=[f"world.servos={servos}"])
    vehicle, start = config.vehicle, config.mission.start
    models = servos_of(vehicle, config.world)
    for model, joint, angle_rad in zip(
        models, vehicle.arm.joints, start_of(start.position_m, start.yaw_deg, start.arm_deg).arm_rad, strict=True
    ):
        model.update(0.0, joint.zero_count * RAD_PER_COUNT + joint.sign * angle_rad, 0.0)
    with sandbox_in(folder / "tool") as sandbox, served(ServoBus(plugged_in(models, config.world))) as port:
        yield Rig(sandbox, port, _copy(folder))


@contextmanager
def served(bus: ServoBus) -> Iterator[str]:
    """The bus's port; its event loop runs in a thread."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, name="bench")
    thread.start()
    try:
        asyncio.run_coroutine_threadsafe(bus.__aenter__(), loop).result()
        try:
            with _patience(bus):
                yield bus.path
        finally:
            asyncio.run_coroutine_threadsafe(bus.__aexit__(None, None, None), loop).result()
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


@contextmanager
def _patience(bus: ServoBus) -> Iterator[None]:
    """In this process a reply is missing only once the bus has answered all that it was asked, however late a busy computer lets it."""
    timed_out = ServoPort.isPacketTimeout

    def is_missing(port: ServoPort) -> bool:
        if not timed_out(port):
            return False
        while select.select((bus,), (), (), 0.0)[0] or bus.unsent:
            time.sleep(0.0005)
        return not port.ser.in_waiting or port.getTimeSinceStart() > NOISE_MS

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(ServoPort, "isPacketTimeout", is_missing)
        yield


def _copy(folder: Path) -> Path:
    return Path(shutil.copy(SHIPPED, folder / "mine.yaml"))


def row_of(document: dict[str, Any], row_id: str) -> dict[str, Any]:
    rows = [row for row in document["rows"] if row["id"] == row_id]
    assert len(rows) == 1, [row["id"] for row in document["rows"]]
    found: dict[str, Any] = rows[0]
    return found


def bad_ids(document: dict[str, Any]) -> set[str]:
    return {row["id"] for row in document["rows"] if not row["ok"]}


def keys(document: dict[str, Any]) -> dict[str, object]:
    """The proposed change."""
    patch = document["patch"]
    return {} if patch is None else {change["key"]: change["new"] for change in patch["changes"]}


__all__: Sequence[str] = ("FILES", "HAND", "Rig", "bad_ids", "bench", "keys", "rig", "row_of")
