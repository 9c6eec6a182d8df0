"""`companion report a.mcap b.mcap` on files: what it writes, what it never overwrites, and what it refuses."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

from companion.analysis import plot_style
from companion.cli.main import main
from companion.cli.report import names_of
from companion.launcher import run as flight_module
from companion.model.exit_codes import EXIT_BAD_INPUT, EXIT_OK
from tests.analysis.synthetic_flight import LANDED_S, record_flight
from tests.campaigns.test_side_by_side import IN_WORLD, configured


@pytest.fixture(scope="module")
def reported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three flights as the recorder writes them, in folders of their own: a whole one with its report, the same with other gains,
    and one that ended before its catch. At 50 Hz: what is tested is what becomes of files, not of figures.
    """
    root = tmp_path_factory.mktemp("reported")
    configs = {"whole": IN_WORLD, "gains": configured(controller__preset="paper"), "short": IN_WORLD}
    for name, config in configs.items():
        (root / name).mkdir()
        log = root / name / "flight.mcap"
        end_s = 5.0 if name == "short" else LANDED_S
        assert record_flight(log, config=config, end_s=end_s, rate_hz=50.0).error is None
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(plot_style, "write_png", lambda figure, path: path.write_bytes(b"drawn"))
        assert main(["report", str(root / "whole/flight.mcap")]) == EXIT_OK
    return root


@pytest.fixture
def flights(tmp_path: Path, reported: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with them; every path is relative to it."""
    shutil.copytree(reported, tmp_path / "flights")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


WHOLE, GAINS, SHORT = (f"flights/{name}/flight.mcap" for name in ("whole", "gains", "short"))


@pytest.mark.usefixtures("undrawn")
def test_two_logs_get_a_folder_of_their_own_and_keep_their_reports(
    flights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents(flights / "flights")
    assert before.keys() >= {"whole/report.html", "whole/tracking.png", "whole/summary.json"}
    capsys.readouterr()
    assert main(["report", WHOLE, GAINS]) == EXIT_OK
    assert capsys.readouterr() == ("reports/whole-vs-gains/side_by_side.html\n", "")
    assert contents(flights / "flights") == before
    written = {path.name for path in (flights / "reports/whole-vs-gains").iterdir()}
    pictures = {f"side_by_side_{name}.png" for name in ("errors", "actuation", "path", "lateness")}
    assert written == pictures | {"side_by_side.html", "side_by_side.json"}
    # Even into a flight's own folder.
    assert main(["report", WHOLE, GAINS, "--out", "flights/whole"]) == EXIT_OK
    assert {name: contents(flights / "flights")[name] for name in before} == before


@pytest.mark.usefixtures("undrawn")
def test_a_comparison_of_other_flights_is_never_overwritten(flights: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", WHOLE, GAINS, "--out", "x"]) == EXIT_OK
    held = contents(flights / "x")
    capsys.readouterr()
    assert main(["report", WHOLE, SHORT, "--out", "x"]) == EXIT_BAD_INPUT
    assert capsys.readouterr().err == (
        "companion report: --out x: already contains a side_by_side.json of other flights; choose another folder\n"
    )
    assert contents(flights / "x") == held
    # Flights of the same name, in another place.
    (flights / "other/whole").mkdir(parents=True)
    (flights / "other/whole/flight.mcap").write_bytes((flights / SHORT).read_bytes())
    assert main(["report", WHOLE, GAINS]) == EXIT_OK
    capsys.readouterr()
    assert main(["report", "other/whole/flight.mcap", GAINS]) == EXIT_OK
    assert capsys.readouterr().out == "reports/whole-vs-gains-2/side_by_side.html\n"


def test_json_is_printed_alone_and_nothing_is_written(flights: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = contents(flights)
    capsys.readouterr()
    assert main(["report", WHOLE, GAINS, WHOLE, "--json"]) == EXIT_OK
    document = json.loads(capsys.readouterr().out)
    assert [flight["letter"] for flight in document["flights"]] == ["A", "B", "C"]
    assert document["flights"][0]["sha256"] == document["flights"][2]["sha256"] != document["flights"][1]["sha256"]
    assert [row["key"] for row in document["configuration"]] == ["controller.preset"]
    assert document["align"] == "catch"
    assert {row["key"] for row in document["figures"]} >= {
        "rms.pre.e_p_m",
        "loop.lateness_ms.p99",
        "tether.min_slack_m",
    }
    assert all(row["differences"][2] == 0 for row in document["figures"])
    assert main(["report", WHOLE, "--json"]) == EXIT_OK
    assert json.loads(capsys.readouterr().out) == json.loads((flights / "flights/whole/summary.json").read_text())
    assert contents(flights) == before


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("flights/whole/summary.json", WHOLE), r"flights/whole/summary\.json: is not an MCAP file; .*"),
        ((WHOLE, "damaged.mcap"), r"damaged\.mcap: damaged: .*"),
        ((WHOLE,) * 7, r"companion report: 7 logs: expected at most 6: .*"),
        ((WHOLE, SHORT, "--align", "catch"), rf"{SHORT}: --align catch: there is no catch in this flight"),
        ((WHOLE, "--align", "catch"), r"companion report: --align: expected two or more logs, got one"),
        ((WHOLE, GAINS, "--out", WHOLE), r"companion report: flights/whole/flight\.mcap: cannot be written: .*--out"),
    ],
)  # fmt: skip
@pytest.mark.usefixtures("undrawn")
def test_bad_input_is_one_line_and_leaves_nothing(
    flights: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], line: str
) -> None:
    data = bytearray((flights / WHOLE).read_bytes())
    data[len(data) // 2 : len(data) // 2 + 64] = bytes(64)
    (flights / "damaged.mcap").write_bytes(data)
    before = contents(flights)
    capsys.readouterr()
    assert main(["report", *words]) == EXIT_BAD_INPUT
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert re.fullmatch(line, err.strip()), err
    assert contents(flights) == before


def test_a_summary_beside_the_log_that_is_of_another_flight_is_rejected(
    flights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Logs that were copied into one folder: its one summary is that of one flight, if of any."""
    for name in ("whole", "short"):
        shutil.copy(flights / f"flights/{name}/flight.mcap", flights / f"{name}.mcap")
    known = json.loads((flights / "flights/whole/summary.json").read_text())
    (flights / "summary.json").write_text(json.dumps(known | {"outcome": "crashed", "payload_kg": 0.25}))
    capsys.readouterr()
    assert main(["report", "whole.mcap", "short.mcap", "--json"]) == EXIT_OK
    out, err = capsys.readouterr()
    one, other = (flight["summary"] for flight in json.loads(out)["flights"])
    assert (one["outcome"], one["payload_kg"]) == ("crashed", 0.25)
    assert (other["outcome"], other["payload_kg"]) == ("lost", None)
    assert err == "summary.json: is the summary of another flight; outcome and payload are unknown\n"
    before = contents(flights)
    for words in (["short.mcap"], ["short.mcap", "--out", "."], ["short.mcap", "--out", ".", "--json"]):
        assert main(["report", *words]) == EXIT_BAD_INPUT
        line = "companion report: .: its summary.json is of another flight; choose another folder with --out\n"
        assert capsys.readouterr() == ("", line)
    assert contents(flights) == before


def test_a_damaged_summary_beside_the_log_costs_one_line_and_no_more(
    flights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (flights / "flights/whole/summary.json").write_text('{"loop": 3, "events": []}')
    capsys.readouterr()
    assert main(["report", WHOLE, GAINS, "--json"]) == EXIT_OK
    out, err = capsys.readouterr()
    assert re.fullmatch(r"flights/whole/summary\.json: .*; outcome and payload are unknown\n", err)
    assert (
        json.loads(out)["flights"][0]["summary"]["loop"]["ticks"]
        == json.loads(out)["flights"][1]["summary"]["loop"]["ticks"]
    )


def test_a_long_log_is_thinned_with_a_note(
    flights: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flight_module, "TICKS_MAX", 500)
    capsys.readouterr()
    assert main(["report", WHOLE, WHOLE, "--json"]) == EXIT_OK
    document = json.loads(capsys.readouterr().out)
    stride = document["flights"][0]["summary"]["graded_every"]
    assert stride > 1
    assert any(f"A one tick in {stride}" in note for note in document["notes"])


def test_flights_have_names_of_their_own() -> None:
    def named(*paths: str) -> list[str]:
        return names_of([Path(path) for path in paths])

    assert named("flights/x/flight.mcap", "flights/y/flight.mcap") == ["x", "y"]
    assert named("a.mcap", "b.mcap") == ["a", "b"]
    assert named("p/x/flight.mcap", "q/x/flight.mcap") == ["p/x", "q/x"]
    assert named("p/x.mcap", "q/x.mcap") == ["p/x", "q/x"]
    assert named("x/flight.mcap", "x/flight.mcap") == ["x (1)", "x (2)"]
