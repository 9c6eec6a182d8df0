"""A simulated world with something wrong about its servos, a vehicle file of its own, and the arm's tools run against them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.exit_codes import EXIT_OK
from tests.support import CATCH, ROOT, Ended, Running, Sandbox, World, sandbox_in

SHIPPED = ROOT / "configs/vehicles/tarot650_2r.yaml"
PATIENT = ("vehicle.devices.arm.watchdog_ms=300", "vehicle.safety.arm_timeout_s=0.4", "vehicle.ground.mqtt=null")
"""A shared machine is held up as a whole now and then, by more than the vehicle file allows."""


OF_THE_COMPUTER = {"arm.reads"}


@dataclass(frozen=True)
class Rig:
    """The world runs; tools are run on its bus, by the vehicle file `vehicle`."""

    sandbox: Sandbox
    world: World
    vehicle: Path

    @property
    def port(self) -> str:
        return str(self.world.devices["arm"]["port"])

    def options(self, *overrides: str) -> list[str]:
        """Of every tool."""
        patient = [word for one in (*PATIENT, *overrides) for word in ("--set", one)]
        return ["--vehicle", str(self.vehicle), *self.world.addresses(), *patient]

    def start(self, *words: str, background: bool = False) -> Running:
        return self.sandbox.start("arm", *words, *self.options(), background=background)

    def run(self, *words: str) -> Ended:
        return self.sandbox.run("arm", *words, *self.options())

    def json(self, *words: str) -> tuple[int, dict[str, Any]]:
        """Exit code and the one document on standard output."""
        ended = self.run(*words, "--json")
        assert ended.out.count("\n") == 1, ended
        document: dict[str, Any] = json.loads(ended.out)
        assert document["schema_version"] == 1 and document["ok"] == (ended.code == EXIT_OK)
        return ended.code, document

    def check_rows(self, *overrides: str) -> dict[str, dict[str, Any]]:
        """The arm's rows of `companion check`."""
        ended = self.sandbox.run("check", CATCH, "--json", *self.options(*overrides))
        rows = {row["id"]: row for row in json.loads(ended.out)["rows"]}
        return {name: row for name, row in rows.items() if name.startswith("arm.")}

    def assert_check_passes_the_arm(self, *overrides: str) -> None:
        """Everything that the tools can put right. How many bus cycles a busy computer misses is not theirs (`OF_THE_COMPUTER`)."""
        rows = self.check_rows(*overrides)
        of_the_arm = [row for name, row in rows.items() if name not in OF_THE_COMPUTER]
        refusing = [row for row in of_the_arm if not row["ok"] and row["level"] == "refuse"]
        assert refusing == [], refusing
        assert {"arm.device", "arm.angles", "arm.mode", "arm.return_delay"} <= set(rows)


@contextmanager
def rig(folder: Path, *overrides: str) -> Iterator[Rig]:
    """A world with these overrides, and a copy of the shipped vehicle file."""
    vehicle = Path(shutil.copy(SHIPPED, folder / "mine.yaml"))
    with (
        sandbox_in(folder / "tool") as sandbox,
        sandbox_in(folder / "world") as around,
        World(around, CATCH, overrides) as world,
    ):
        yield Rig(sandbox, world, vehicle)


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


__all__: Sequence[str] = ("Rig", "bad_ids", "keys", "rig", "row_of")
