"""A control law of another distribution: where a user meets it, and when a log of it can be replayed."""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from rich.console import Console

from companion import DISTRIBUTION, __version__
from companion.analysis.log import FlightLog, LogError
from companion.analysis.replay import check_replayable
from companion.cli.check import show
from companion.cli.main import main
from companion.cli.schema import schema_json
from companion.config.loader import load_flight, logged_flight
from companion.ground.station.replay_log import read_for_page
from companion.model.codec import fingerprint
from companion.model.outputs import Outputs, Sent
from companion.model.types import Inputs, OperatorCommand
from companion.plugins import PluginError
from companion.sitl_config.loader import load_sitl
from sitl.campaigns.flights import fly_to_end, row_of
from tests.plugins.installed import LAW, STEP, on_path, write_law


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Path]:
    write_law(tmp_path)
    with on_path(tmp_path):
        yield tmp_path


@pytest.mark.usefixtures("site")
def test_it_is_chosen_on_the_command_line_and_shown_where_the_others_are(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "hover", "--plan-only", "--controller", "lift", "--preset", "stiff"]) == 0
    for words, shown in (
        (["fly", "--help"], ("control law: adaptive, csc, psc, policy, lift", "lift: soft, stiff")),
        (["compare", "--help"], ("default: the presets of adaptive,csc,psc,lift",)),
    ):
        with pytest.raises(SystemExit):
            main(words)
        out = " ".join(capsys.readouterr().out.split())
        assert [text for text in shown if text not in out] == []
    assert main(["check", "hover", "--plan-only", "--controller", "lift", "--preset", "hard"]) == 2
    assert capsys.readouterr().err == "--preset hard: no such preset of 'lift'; available: stiff, soft\n"


@pytest.mark.usefixtures("site")
def test_its_settings_are_checked_and_are_in_the_schema() -> None:
    config = load_flight("hover", controller_law="lift", overrides=["controller.lift_n=2"])
    assert config.controller.model_dump()["lift_n"] == 2.0
    assert logged_flight(config.model_dump_json()) == config
    schema = json.loads(schema_json("controller"))
    assert schema["discriminator"]["mapping"]["lift"] == "#/$defs/LiftConfig"
    assert schema["$defs"]["LiftConfig"]["properties"]["lift_n"]["type"] == "number"
    assert json.loads(schema_json("mission"))["$defs"]["ControllerChoice"]["properties"]["law"]["enum"][-1] == "lift"


@pytest.mark.usefixtures("site")
def test_it_is_listed_with_its_distribution(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plugins"]) == 0
    heading, *rows = (line.split() for line in capsys.readouterr().out.splitlines())
    assert heading == ["name", "kind", "distribution", "version", "what", "it", "is"]
    laws = [row for row in rows if row[1] == "control"]
    assert laws[-1] == ["lift", "control", "law", "lab-a", "1.0", "A", "law", "for", "tests."]
    assert [(row[0], row[3]) for row in laws[:-1]] == [
        (law, DISTRIBUTION) for law in ("adaptive", "csc", "psc", "policy")
    ]


@pytest.mark.usefixtures("site")
def test_a_check_names_it_with_its_distribution() -> None:
    out, config = io.StringIO(), load_sitl("hover", controller_law="lift")
    show(Console(file=out, width=200), [], config, simulated=False)
    assert out.getvalue().startswith("tarot650-2r, mission 'hover', control law 'lift' (lab-a 1.0)")


def assert_refused(capsys: pytest.CaptureFixture[str], reason: str) -> None:
    """The law is refused by name in one line."""
    assert main(["check", "hover", "--plan-only", "--controller", "lift"]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1
    assert err.startswith("control law 'lift' (lab-a 1.0): ") and reason in err


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("import PscController", "import Pid", "lab_a:Lift cannot be imported: ImportError: cannot import name 'Pid'"),
        ("settings = LiftConfig", "pass", "'law' of PscConfig is not Literal[\"lift\"]"),
        ("settings = LiftConfig", "settings = dict", "'settings' is not a subclass of companion.config.controller."),
        ('("stiff", "soft")', "()", "LiftConfig names no presets"),
        ('("stiff", "soft")', '("hard",)', "files/controllers/lift_hard.yaml does not exist"),
    ],
)
def test_one_that_cannot_be_used_is_refused_by_name_and_does_not_disturb_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, reason: str
) -> None:
    write_law(tmp_path, LAW.replace(old, new))
    with on_path(tmp_path):
        assert_refused(capsys, reason)
        assert main(["check", "hover", "--plan-only"]) == 0
        with pytest.raises(SystemExit):
            main(["fly", "--help"])
        assert "lift: see companion plugins" in " ".join(capsys.readouterr().out.split())
        assert main(["plugins"]) == 2
        assert "cannot be used: " in capsys.readouterr().out


AN_INPUT = Inputs(tick=0, t_s=0.0, recorder_dropped=0, command=OperatorCommand.NONE)


def log_by(distribution: str, version: str, **phases: str) -> FlightLog:
    """The head of a log that the law `lift` flew, with phases of others."""
    about = {"version_companion": __version__, "records": fingerprint(Inputs, Outputs, Sent)}
    flight = {"law": "lift", "law_distribution": distribution, "law_version": version, **phases}
    return FlightLog(
        path=Path("flight.mcap"),
        inputs=(),
        outputs=(),
        sent=(),
        metadata={"companion": about, "flight": flight},
        closed=True,
    )


@pytest.mark.usefixtures("site")
@pytest.mark.parametrize("other", [("lab-a", "0.9"), ("lab-b", "1.0")])
def test_a_log_is_not_replayed_by_another_version_of_the_law(other: tuple[str, str]) -> None:
    with pytest.raises(LogError, match=r"was flown by control law 'lift' of lab-\S+ \S+, but lab-a 1\.0 is installed"):
        check_replayable(log_by(*other))
    with pytest.raises(LogError, match="has no configuration"):
        check_replayable(log_by("lab-a", "1.0"))


@pytest.mark.usefixtures("site")
def test_a_log_is_not_replayed_without_the_phase_that_flew() -> None:
    with pytest.raises(LogError, match=r"was flown by phase 'weigh' of lab-weigh 0\.2, but it is not installed"):
        check_replayable(log_by("lab-a", "1.0", phase_weigh="lab-weigh 0.2"))


def test_a_log_is_neither_replayed_nor_shown_without_its_law(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_law(tmp_path)
    with on_path(tmp_path):
        config_json = load_flight("hover", controller_law="lift").model_dump_json()
    with pytest.raises(LogError, match=r"'lift' of lab-a 1\.0, but it is not installed; install that version"):
        check_replayable(log_by("lab-a", "1.0"))
    with pytest.raises(PluginError, match=r"^control law 'lift': is not installed"):
        logged_flight(config_json)
    log = dataclasses.replace(log_by("lab-a", "1.0"), inputs=(AN_INPUT,), metadata={"config": {"json": config_json}})
    monkeypatch.setattr(FlightLog, "read", lambda *_, **__: log)
    with pytest.raises(LogError, match=r"^flight\.mcap: control law 'lift': is not installed"):
        read_for_page(log.path, 0)


REPLACE = "from msgspec.structs import replace\n"


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("\n    def __init__(self, config):\n        pass\n", "cannot be built: TypeError: Lift.__init__() takes 2 "),
        ("\n    __slots__ = ()\n    def __init__(self, *_):\n        1 / 0\n", "cannot be built: ZeroDivisionError: division"),
        ("\n    def step(self, state):\n        pass\n", "step raises TypeError: Lift.step() takes 2 positional arguments"),
        ("\n    step = None\n", "step raises TypeError: 'NoneType' object is not callable"),
        (STEP + "return wrench.collective_n\n", "step returns a float, not a companion.control.types.Wrench"),
        (STEP + "return replace(wrench, collective_n=float('nan'))\n", "step returns collective_n = nan, which is not finite"),
        (STEP + "return replace(wrench, arm_torque_nm=(0.0,))\n", "arm_torque_nm of length 1, expected 2"),
        (STEP + "return replace(wrench, arm_torque_nm=[0.0, 0.0])\n", "step returns a Wrench with a list in place of a tuple"),
        (STEP + "return replace(wrench, log=replace(wrench.log, rho=float('inf')))\n", "step returns log.rho = inf, which"),
        (STEP + "return replace(wrench, attitude_wxyz=(0.0, 0.0, 0.0, 0.0))\n", "attitude_wxyz of norm 0, expected 1"),
        (STEP + "return replace(wrench, collective_n=-1.0)\n", "step returns collective_n = -1, expected 0 or more"),
        (STEP + "import time; time.sleep(0.006)\n        return wrench\n", "ms or more (limit 5 ms, one tick)"),
    ],
)  # fmt: skip
def test_one_that_fails_its_trial_is_refused_by_name_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], code: str, reason: str
) -> None:
    write_law(tmp_path, REPLACE + LAW + code)
    with on_path(tmp_path):
        assert_refused(capsys, reason)


@pytest.mark.parametrize(
    "command",
    ["fly hover --sitl --controller lift", "check hover --sitl --controller lift", "compare --controllers lift"],
)
def test_one_that_fails_its_trial_is_refused_before_anything_is_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    write_law(tmp_path, LAW + "\n    step = None\n")
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.iterdir())
    with on_path(tmp_path):
        assert main(command.split()) == 2
    assert "step raises TypeError" in capsys.readouterr().err
    assert [path for path in sorted(tmp_path.iterdir()) if path.name != "__pycache__"] == before


NOT_FINITE = "ValueError: the control law's thrust or tracking error is not finite"
BROKEN = "(float('nan'), *wrench.log.error[1:])"


@pytest.mark.parametrize(
    ("broken", "lost"),
    [
        ("raise RuntimeError('stuck')", "RuntimeError: stuck"),
        ("return replace(wrench, collective_n=float('nan'))", NOT_FINITE),
        (f"return replace(wrench, log=replace(wrench.log, error={BROKEN}))", NOT_FINITE),
    ],
)
def test_one_that_fails_in_the_air_ends_the_flight_as_every_exception_of_the_core_does(
    tmp_path: Path, broken: str, lost: str
) -> None:
    """A campaign reports the flight as lost. Over the wires the guardian lands: tests/launcher/test_team.py."""
    code = f"if 0.5 < state.position_world_m[2] < 0.9:\n            {broken}\n        return wrench\n"
    write_law(tmp_path, REPLACE + LAW + STEP + code)
    with on_path(tmp_path):
        flown = fly_to_end(load_sitl("hover", controller_law="lift"))
        row, _ = row_of(flown.config, flown.result, None, flown.error)
    assert (row["outcome"], row["error"]) == ("lost", lost)
