"""Commands say that a log ends before its flight did: its file is cut off, or the flight process was killed."""

from __future__ import annotations

import gzip
import json
import re
from pathlib import Path

import pytest

from companion.analysis.log import FlightLog
from companion.ground.station.replay_log import read_for_page
from companion.sitl_config.loader import load_sitl
from sitl.campaigns.flights import log_of
from sitl.fast.loop import FastFlight
from tests.analysis.recorded import record
from tests.commands import companion
from tests.support import run_here

END = r"the log ends before the flight did: its last whole tick is at t = (\d+\.\d{3}) s, the outcome is not in it"


@pytest.fixture(scope="module")
def killed(short_start: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a flight whose process was killed in the air: the recorder has closed it."""
    flight = FastFlight(load_sitl("configs/missions/catch.yaml"))
    log = log_of(flight.config.flight, flight.run(until_mission_s=6.0), None)
    return record(log, tmp_path_factory.mktemp("killed") / "flight.mcap")


@pytest.fixture(scope="module")
def cut(killed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cut") / "flight.mcap"
    data = killed.read_bytes()
    path.write_bytes(data[: len(data) * 3 // 5])
    return path


@pytest.mark.parametrize("name", ["killed", "cut"])
def test_a_replay_names_the_last_tick_that_it_has_compared(name: str, request: pytest.FixtureRequest) -> None:
    path: Path = request.getfixturevalue(name)
    log = FlightLog.read(path)
    assert log.closed == (name == "killed")
    replayed = companion("replay", path)
    found = re.fullmatch(
        rf"{path}: {len(log.inputs)} ticks replayed, every output bit-identical; {END}\n", replayed.out
    )
    assert found is not None, replayed
    assert float(found[1]) == pytest.approx(log.inputs[-1].t_s, abs=0.001)


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    "command", ["report", "report --json", "hover fit", "identify", "export --format csv", "export --format foxglove"]
)
def test_every_command_says_that_the_end_is_missing(command: str, cut: Path, tmp_path: Path) -> None:
    if "export" in command:
        pytest.importorskip("pyarrow")
    out = () if "hover" in command or "json" in command else ("--out", tmp_path / "out")
    ended = run_here(*command.split(), cut, *out)
    (line,) = [line for line in ended.err_lines if "ends before" in line]
    assert re.match(rf"{cut}: (.*; )?{END}", line)
    if "--json" in command:
        assert re.fullmatch(END, json.loads(ended.out)["log_end_missing"])
    elif command == "report":
        assert re.search(END, (tmp_path / "out/report.html").read_text(encoding="utf-8"))


@pytest.mark.usefixtures("undrawn")
def test_a_comparison_and_the_page_of_the_monitor_say_so(killed: Path, cut: Path, tmp_path: Path) -> None:
    compared = companion("report", killed, cut, "--json", "--align", "start")
    cautions = json.loads(compared.out)["cautions"]
    for letter in ("A", "B"):
        assert any(re.fullmatch(rf"{letter}: {END}\.", caution) for caution in cautions), cautions
    assert re.search(END, json.loads(gzip.decompress(read_for_page(cut, 0).gzip_json))["state"]["text"])
