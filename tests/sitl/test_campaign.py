"""Grids of fast flights: one flight's row, and the same rows over one process, two processes and a Dask cluster."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import math
import os
import pty
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from companion.analysis import metrics
from companion.campaigns.process import CampaignError, CampaignProcess
from companion.campaigns.robustness.cases import read_cases
from companion.mission.plan import Plan
from companion.model.exit_codes import EXIT_ABORTED, EXIT_BAD_INPUT, EXIT_OK
from companion.model.types import Outcome, PhaseKind
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.campaigns import compare, faults, flights, robustness, runner
from sitl.campaigns.flights import Flown
from sitl.campaigns.runner import Fly
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from tests.campaigns.made_up import fly_here
from tests.machines import overrides_with_joints
from tests.support import DEADLINE_S, SHORT_CATCH, Sandbox, position_error_m, run_here, sandbox_in, wait_until

CONFIG = load_sitl(SHORT_CATCH, preset="recommended", overrides=("world.payload_kg=0.7", "world.seed=9"))
"""With another payload and seed than `FLIGHT`, which sets its own."""
FLIGHT: dict[str, Any] = {
    "variant": 0,
    "controller": "adaptive",
    "preset": "recommended",
    "payload_kg": 0.2,
    "seed": 3,
    "model_error": 0.0,
}


@dataclasses.dataclass(frozen=True)
class Seen:
    """A flight of a campaign: what the campaign made of it, and the flight itself."""

    made: dict[str, Any]
    flown: Flown

    @property
    def result(self) -> FastResult:
        return self.flown.result

    @property
    def caught_t_s(self) -> float:
        assert self.flown.caught_t_s is not None
        return self.flown.caught_t_s


@pytest.fixture(scope="module")
def seen() -> Seen:
    """`FLIGHT`, flown once for all tests."""
    flown: list[Flown] = []

    def fly_to_end(config: SitlConfig) -> Flown:
        flown.append(flights.fly_to_end(config))
        return flown[-1]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(compare, "fly_to_end", fly_to_end)
        made = compare.fly(CONFIG, FLIGHT)
    return Seen(made, flown[0])


def test_a_flight_has_time_to_end_however_long_its_mission_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[float] = []

    def run(_: FastFlight, limit_s: float, until_mission_s: float) -> FastResult:
        given.append(limit_s)
        return FastResult()

    monkeypatch.setattr(FastFlight, "run", run)
    config = load_sitl("probe")
    flights.fly_to_end(config)
    assert given[0] - 60.0 > Plan.build(config.mission, config.vehicle).duration_s > 90.0


def test_a_mission_that_takes_longer_than_a_campaign_waits_for_is_refused() -> None:
    ended = run_here("compare", "--mission", "soak", "--seeds", "1")
    assert ended.code == EXIT_BAD_INPUT
    assert ended.err_lines == [
        "soak: expected a mission of at most 300 s, got 3607 s; lower repeat, or fly it with companion fly"
    ]


def test_a_row_is_what_the_flight_was(seen: Seen) -> None:
    row, result = seen.made["row"], seen.result
    head = {key: FLIGHT[key] for key in ("controller", "preset", "payload_kg", "seed", "model_error")}
    head["world_seed"] = FLIGHT["seed"]
    assert {key: row[key] for key in head} == head
    assert (seen.flown.config.world.payload_kg, seen.flown.config.world.seed) == (0.2, 3)
    assert (row["outcome"], row["error"]) == ("completed", None)
    parts: dict[str, list[float]] = {"pre": [], "post": []}
    for i, o in zip(result.inputs, result.outputs, strict=True):
        if o.phase_kind is PhaseKind.FLIGHT:
            parts["post" if o.t_s >= seen.caught_t_s else "pre"].append(position_error_m(i, o))
    for part, errors in parts.items():
        rms = math.sqrt(math.fsum(error**2 for error in errors) / len(errors))
        assert row["rms"][part]["e_p_m"] == pytest.approx(rms, rel=1e-9)
    assert row["peak_e_p_m"] == pytest.approx(max(parts["pre"] + parts["post"]), rel=1e-9)
    assert row["caught"] is True
    assert row["catch_t_s"] == pytest.approx(2.45, abs=0.05)
    assert 0.0 < row["impedance_error"]["arm_nm"] < 1.0
    torques = [o.arm_torque_nm for o in result.outputs if o.phase_kind is PhaseKind.FLIGHT]
    changes = [math.dist(a, b) for a, b in itertools.pairwise(torques) if a is not None and b is not None]
    assert row["torque_activity_nm"] == pytest.approx(
        math.sqrt(math.fsum(c * c for c in changes) / len(changes)), rel=1e-9
    )


def test_a_catch_that_was_not_noticed_still_divides_the_flight(seen: Seen) -> None:
    flown, caught_t_s = seen.result, seen.caught_t_s
    outputs = [replace(o, events=tuple(event for event in o.events if event.id != "catch")) for o in flown.outputs]
    row, log = flights.row_of(seen.flown.config.flight, FastResult(inputs=flown.inputs, outputs=outputs), caught_t_s)
    index = metrics.catch_index(log)
    assert index is not None
    assert log.outputs[index].t_s == pytest.approx(caught_t_s, abs=0.006)
    noticed, _ = flights.row_of(seen.flown.config.flight, flown, caught_t_s)
    assert (row["caught"], row["catch_t_s"]) == (True, None)
    assert row["rms"] == noticed["rms"]


def test_a_reported_catch_that_was_none_is_not_graded_as_one(seen: Seen) -> None:
    row, log = flights.row_of(seen.flown.config.flight, seen.result, None)
    assert row["caught"] is False
    assert row["catch_t_s"] == seen.made["row"]["catch_t_s"], "what the companion reported"
    assert metrics.catch_index(log) is None
    assert set(row["rms"]["post"].values()) == set(row["impedance_error"].values()) == {None}


def test_what_was_not_flown_to_its_end_is_not_graded(seen: Seen) -> None:
    flown, caught_t_s = seen.result, seen.caught_t_s
    for end_s, graded in ((caught_t_s - 1.0, set()), (caught_t_s + 2.0, {"pre"})):
        count = sum(o.t_s <= end_s for o in flown.outputs)
        short = FastResult(inputs=flown.inputs[:count], outputs=flown.outputs[:count], crashed=True)
        row, _ = flights.row_of(seen.flown.config.flight, short, caught_t_s)
        assert row["outcome"] == Outcome.CRASHED.value
        assert {part for part, rms in row["rms"].items() if rms["e_p_m"] is not None} == graded
        for name in ("final_e_z_m", "peak_e_p_m", "torque_activity_nm"):
            assert row[name] is None
        assert set(row["impedance_error"].values()) == {None}


def test_without_an_arm_there_is_no_torque_activity() -> None:
    config = load_sitl(SHORT_CATCH, overrides=(*overrides_with_joints(0), "world.payload_kg=0"))
    result = FastFlight(config).run(2.0)
    log = flights.log_of(config.flight, result, None)
    assert flights.torque_activity_nm(log, np.ones(len(result.outputs), np.bool_)) is None


@pytest.mark.parametrize(
    ("fly", "flight"),
    [
        (compare.fly, FLIGHT),
        (robustness.fly, {"name": "draw 0", "number": 0, "world": {"payload_kg": 0.1}}),
        (faults.fly, {"kind": "gust", "size": 4.0, "duration_s": None, "phase": "line"}),
    ],
)
def test_a_law_that_breaks_loses_its_flight_and_no_other(
    monkeypatch: pytest.MonkeyPatch, fly: Fly, flight: dict[str, Any]
) -> None:
    def breaks(*_: object) -> FastResult:
        raise ZeroDivisionError("float division by zero")

    monkeypatch.setattr(FastFlight, "run", breaks)
    row = fly(CONFIG, flight)["row"]
    assert (row["outcome"], row["error"]) == ("lost", "ZeroDivisionError: float division by zero")
    assert row.get("e_p_m") is None and row.get("peak_e_p_m") is None


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Sandbox]:
    with sandbox_in(tmp_path_factory.mktemp("campaign")) as sandbox:
        yield sandbox


TINY = (
    *("compare", "--mission", SHORT_CATCH, "--payloads", "0.2", "--controllers", "adaptive"),
    *("--presets", "paper,recommended", "--json"),
)


def job_of(jobs: int | None, scheduler: str | None, more: int = 0) -> dict[str, Any]:
    """`FLIGHT` as a job, and more flights after it."""
    return {
        "campaign": "compare",
        "configs": [CONFIG.model_dump(mode="json")],
        "flights": [FLIGHT, *({**FLIGHT, "seed": seed} for seed in range(more))],
        "jobs": jobs,
        "scheduler": scheduler,
    }


def assert_same_flight(flown: list[dict[str, Any]], seen: Seen) -> None:
    (found,) = (message for message in flown if message["index"] == 0)
    assert found["row"] == seen.made["row"]


def test_two_processes_fly_the_same_row_and_end_with_the_program_that_started_them(seen: Seen, place: Sandbox) -> None:
    with subprocess.Popen(
        [sys.executable, "-m", "sitl.campaigns"],
        cwd=place.cwd,
        env=place.environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,
    ) as process:
        assert process.stdin is not None and process.stdout is not None
        process.stdin.write(json.dumps(job_of(2, None, more=500)).encode() + b"\n")
        process.stdin.flush()
        flown: list[dict[str, Any]] = []
        while 0 not in {message["index"] for message in flown}:
            flown.append(json.loads(process.stdout.readline()))
        process.stdin.close()
        process.wait(DEADLINE_S)
    assert process.returncode != 0
    place.assert_nobody_left(DEADLINE_S)
    assert_same_flight(flown, seen)


def test_a_dask_cluster_flies_the_same_row(seen: Seen, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed", reason="Dask is not installed (extra cluster)")
    with (
        distributed.LocalCluster(1, 1, processes=False, protocol="tcp", dashboard_address=None) as cluster,
        CampaignProcess(job_of(None, cluster.scheduler_address), tmp_path / "campaign.log") as process,
    ):
        assert_same_flight(list(process.results()), seen)


def test_a_scheduler_that_is_not_there_is_bad_input(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed", reason="Dask is not installed (extra cluster)")
    monkeypatch.setattr(runner, "SCHEDULER_TIMEOUT_S", 0.2)
    with pytest.raises(CampaignError, match=r"^--scheduler tcp://127.0.0.1:9: no Dask scheduler answers.*$") as refused:
        next(runner._over_machines([], "tcp://127.0.0.1:9"))
    assert refused.value.bad_input


def test_ctrl_c_ends_the_workers_and_shows_what_is_there(place: Sandbox) -> None:
    arguments = [*map(str, TINY), "--seeds", "500", "--jobs", "2", "--out", "part"]
    with (
        terminal() as (theirs, seen),
        subprocess.Popen(
            [sys.executable, "-m", "companion", *arguments],
            cwd=place.cwd,
            env={**place.environment, "TERM": "xterm"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=theirs,
            start_new_session=True,
        ) as process,
    ):
        os.close(theirs)
        bar = re.compile(rb"\b[1-9]\d*/1000")
        wait_until(lambda: bool(bar.search(seen)), lambda: f"no flight has ended: {bytes(seen)!r}")
        os.killpg(process.pid, signal.SIGINT)
        out, _ = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == EXIT_ABORTED
    place.assert_nobody_left(DEADLINE_S)
    rows = json.loads(out)["rows"]
    assert 1 <= len(rows) < 1000
    assert f"{len(rows)} of 1000 flights were flown".encode() in seen
    assert (place.cwd / "part/compare.html").exists()


@pytest.mark.usefixtures("undrawn")
def test_a_draw_is_flown_again_as_a_case(place: Sandbox, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place.cwd)
    fly_here(monkeypatch)
    options = ("--json",)
    machine = ("--vehicle", "hexa_2r", "--set", "vehicle.safety.arm_timeout_s=0.4", "--model-error", "0.1")
    ended = run_here("robustness", SHORT_CATCH, *machine, "--draws", "1", *options, "--out", "draws")
    assert ended.code == EXIT_OK, ended.err
    (draw,) = json.loads(ended.out)["rows"]
    assert draw["outcome"] == "completed" and draw["e_p_m"] is not None
    kept = read_cases(Path("draws/worst.yaml"))
    assert (kept.vehicle, kept.overrides) == ("hexa_2r", ("vehicle.safety.arm_timeout_s=0.4",))
    again = run_here("robustness", "--cases", "draws/worst.yaml", *options, "--out", "cases")
    assert again.code == EXIT_OK, again.err
    (case,) = json.loads(again.out)["rows"]
    assert {**case, "name": "", "number": 0} == {**draw, "name": ""}


@contextlib.contextmanager
def terminal() -> Iterator[tuple[int, bytearray]]:
    """A terminal: the end for a program, and what that has shown."""
    ours, theirs = pty.openpty()
    seen = bytearray()

    def listen() -> None:
        with contextlib.suppress(OSError):  # the other end is closed
            while data := os.read(ours, 65536):
                seen.extend(data)

    reader = threading.Thread(target=listen)
    reader.start()
    try:
        yield theirs, seen
    finally:
        reader.join(DEADLINE_S)
        os.close(ours)
