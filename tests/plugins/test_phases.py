"""Types of mission phases: those of the companion keep the contract, and one of another package flies without a change of ours."""

from __future__ import annotations

import itertools
import math
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from msgspec.structs import replace

from companion.cli.main import main
from companion.config.document import ConfigError
from companion.config.loader import load_flight
from companion.config.phase import PhaseSettings, phase_classes
from companion.core.flight_core import FlightCore
from companion.flight.main import plugins_of_others
from companion.mission.check import check_mission
from companion.mission.plan import Plan
from companion.model.exit_codes import EXIT_BAD_INPUT, EXIT_OK
from companion.model.outputs import Outputs
from companion.model.types import Inputs, OperatorCommand, Outcome, SafetyAction
from companion.plugins import PHASES
from companion.sitl_config.loader import load_sitl
from companion.testing import check_phases
from sitl.fast.loop import FastFlight
from sitl.testing import check_flight
from tests.plugins.installed import on_path, write_distribution
from tests.support import ROOT

pytestmark = pytest.mark.usefixtures("short_start")

EXAMPLE = ROOT / "examples/phase"
MISSION = EXAMPLE / "weigh.yaml"
FILES = ("pyproject.toml", "lab_weigh.py", "weigh.yaml", "test_lab_weigh.py")
FLOWN = ("circuit", "intercept", "press", "slide", "probe")
PAGE = (ROOT / "docs/own-phase.md").read_text(encoding="utf-8")
CODE = (EXAMPLE / "lab_weigh.py").read_text(encoding="utf-8")


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Path]:
    """A folder with the example's package, installed."""
    shutil.copy(EXAMPLE / "lab_weigh.py", tmp_path)
    write_distribution(tmp_path, "lab-weigh", "0.1.0", {"weigh": "lab_weigh:Weigh"}, PHASES)
    with on_path(tmp_path):
        yield tmp_path


@pytest.mark.parametrize("mission", FLOWN)
def test_the_companions_own_phases_keep_the_contract(mission: str) -> None:
    check_phases(mission)


def test_which_types_the_checked_missions_do_not_have() -> None:
    flown = {phase.type for mission in FLOWN for phase in load_flight(mission).mission.phases}
    assert set(phase_classes()) - flown == {
        "arm",
        "grip",
        "carry",
        "release",
    }  # the last three: tests/sitl/test_pair.py


def test_the_page_shows_the_files_as_they_are() -> None:
    for name in FILES:
        kind = {".toml": "toml", ".py": "python", ".yaml": "yaml"}[Path(name).suffix]
        assert f"`{name}`:\n\n```{kind}\n{(EXAMPLE / name).read_text(encoding='utf-8')}```\n" in PAGE, name


def test_a_phase_of_another_package_keeps_the_contract_and_weighs_the_payload(site: Path) -> None:
    check_phases(MISSION)
    events = check_flight(MISSION, "world.payload_kg=0.25")
    (text,) = [event.text for event in events if event.id == "weighed"]
    assert float(text.split()[-2]) == pytest.approx(0.25, abs=0.015)
    assert plugins_of_others(load_flight(MISSION)) == {"phase_weigh": "lab-weigh 0.1.0"}, "in the log, for the replay"
    assert plugins_of_others(load_flight("catch")) == {}


def test_its_checks_are_part_of_those_before_take_off(site: Path) -> None:
    config = load_flight(MISSION)
    devices = config.vehicle.devices.model_copy(update={"force": None})
    found = check_mission(config.mission, config.vehicle.model_copy(update={"devices": devices}))
    assert any("phase 'weigh' weighs, but vehicle" in problem for problem in found)


def test_it_is_listed(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plugins"]) == EXIT_OK
    (row,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("weigh ")]
    assert row.split()[:4] == ["weigh", "phase", "lab-weigh", "0.1.0"]
    assert row.endswith("Hover, and report the mass of what is in the net.")


def test_a_type_that_is_not_installed_is_named_with_its_place_and_the_nearest_one(tmp_path: Path) -> None:
    written = tmp_path / "mission.yaml"
    written.write_text(MISSION.read_text(encoding="utf-8").replace("weigh\n    duration", "presss\n    duration"))
    with pytest.raises(ConfigError) as caught:
        load_flight(written, "tarot650_2r")
    (line,) = caught.value.lines
    assert line.startswith(f"{written}:35:11: phases[4].type: expected one of approach, arm, carry, detach, grip, ")
    assert line.endswith('got "presss" (did you mean press?)')


BROKEN = [
    ("raise OSError('no licence')\n" + CODE, "lab_weigh:Weigh cannot be imported: OSError: no licence"),
    (CODE.replace('Literal["weigh"]', 'Literal["scale"]'), "the field 'type' of Weigh is not Literal[\"weigh\"]"),
    (CODE.replace("(Phase):", "(Record):"), "it is not a subclass of companion.mission.phase.Phase"),
]


@pytest.mark.parametrize(("code", "reason"), BROKEN, ids=["import", "type", "class"])
def test_a_type_that_cannot_be_used_spoils_only_the_missions_that_name_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], code: str, reason: str
) -> None:
    (tmp_path / "lab_weigh.py").write_text(code)
    write_distribution(tmp_path, "lab-weigh", "0.1.0", {"weigh": "lab_weigh:Weigh"}, PHASES)
    with on_path(tmp_path):
        assert all(isinstance(phase, PhaseSettings) for phase in load_flight("catch").mission.phases)
        with pytest.raises(ConfigError) as caught:
            load_flight(MISSION)
        assert caught.value.lines == (f"{MISSION}:35:5: phases[4]: phase 'weigh' (lab-weigh 0.1.0): {reason}",)
        assert main(["plugins"]) == EXIT_BAD_INPUT
    assert f"cannot be used: {reason}" in capsys.readouterr().out


BREACHES = [
    ("p.builder.t_s += self.duration_s", "p.builder.stop((0.5, 0.0, 0.0)); p.builder.t_s += 2.0", "m/s at t = "),
    ("return Weighing(air.t_s, 0, 0.0)", "return air.t_s", "its state is float, expected a Record"),
    ("air.stay(air.engaged)", "Weigh.n = getattr(Weigh, 'n', 0.0) + 1.0; own = replace(own, mean_n=Weigh.n)", "the same inputs twice"),
]  # fmt: skip


@pytest.mark.parametrize(("right", "wrong", "found"), BREACHES, ids=["plan", "state", "replay"])
def test_a_phase_that_breaks_the_contract_is_told_how(site: Path, right: str, wrong: str, found: str) -> None:
    assert right in CODE
    (site / "lab_weigh.py").write_text(CODE.replace(right, wrong))
    with pytest.raises(AssertionError) as caught:
        check_phases(MISSION)
    assert "phases[4], weigh" in str(caught.value) and found in str(caught.value)


def test_the_pages_phase_that_moves_keeps_the_contract_and_flies(tmp_path: Path) -> None:
    (square,) = re.findall(r"^```python\n(class Square.*?)^```", PAGE, flags=re.M | re.S)
    imports = "import math\nfrom dataclasses import replace\nfrom typing import Annotated\nfrom pydantic import Field\n"
    (tmp_path / "lab_square.py").write_text(f"{imports}from lab_weigh import Literal, Phase, Planning\n\n{square}")
    shutil.copy(EXAMPLE / "lab_weigh.py", tmp_path)
    write_distribution(tmp_path, "lab-square", "0.1.0", {"square": "lab_square:Square"}, PHASES)
    mission = tmp_path / "square.yaml"
    hover = (ROOT / "configs/missions/hover.yaml").read_text(encoding="utf-8")
    moved = hover.replace("type: hold, duration_s: 5.0", "type: square, side_m: 0.4, speed_m_s: 0.4")
    mission.write_text(moved.replace("../vehicles", str(ROOT / "configs/vehicles")), encoding="utf-8")
    with on_path(tmp_path):
        check_phases(mission)
        plan = Plan.build((config := load_flight(mission)).mission, config.vehicle)
        turned = plan.reference(plan.segments[1].end_s)
        assert (turned.position_world_m, turned.yaw_rad) == ((-1.0, 0.0, 1.0), math.pi / 2)
        assert [event.id for event in check_flight(mission, "world.payload_kg=0")] == ["takeoff", "touchdown"]


def test_the_contract_lets_the_plans_time_pass(site: Path) -> None:
    over = "air.t_s - state.since_s < self.duration_s"
    assert over in CODE
    code = CODE.replace("        air.stay(air.engaged)\n", "").replace(over, "air.plan_s() < self.duration_s")
    (site / "lab_weigh.py").write_text(code.replace("air.report(WEIGHED", "assert False, str(air.plan_s())  #"))
    with pytest.raises(AssertionError, match=r"^2\.0"):
        check_phases(MISSION)


RAISES = {
    "step": ("        air.stay(air.engaged)\n", "        1 / (air.t_s < self.duration_s)\n"),
    "reference": ("    def begin(", "    def reference(self, reference, own):\n        return own.n\n\n    def begin("),
    "short reference": (
        "    def begin(",
        "    def reference(self, reference, own):\n        return replace(reference, position_world_m=(0.0, 1.0))\n\n    def begin(",
    ),
    "not finite": (
        "    def begin(",
        "    def reference(self, reference, own):\n        return replace(reference, yaw_rad=float('nan'))\n\n    def begin(",
    ),
    "joints": (
        "    def begin(",
        "    def reference(self, reference, own):\n        return replace(reference, arm_rad=(0.0,))\n\n    def begin(",
    ),
    "expects": ("    def begin(", "    def expects(self, own):\n        return None\n\n    def begin("),
    "leave": ("    def begin(", "    def leave(self, own, t_s):\n        return own.n\n\n    def begin("),
}
SOON = [
    "mission.catch=null",
    "mission.phases[0]={type: takeoff, height_m: 0.8, duration_s: 2.0}",
    "mission.phases[2]={type: arm, arm_deg: unfolded}",
    "mission.phases[3].duration_s=0.1",
]
"""The mission without its way: it weighs some seconds after the take-off, high enough to hold."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> list[Inputs]:
    """The inputs of a flight, until it has weighed for a while."""
    folder = tmp_path_factory.mktemp("flown")
    shutil.copy(EXAMPLE / "lab_weigh.py", folder)
    write_distribution(folder, "lab-weigh", "0.1.0", {"weigh": "lab_weigh:Weigh"}, PHASES)
    ticks = itertools.count()
    with on_path(folder):
        flight = FastFlight(load_sitl(MISSION, overrides=SOON))
        return flight.run(until=lambda o: o.phase == "weigh" and next(ticks) == 20).inputs


def broken(site: Path, method: str) -> FastFlight:
    right, wrong = RAISES[method]
    assert right in CODE
    (site / "lab_weigh.py").write_text(CODE.replace(right, wrong))
    return FastFlight(load_sitl(MISSION, overrides=SOON))


def failed(outputs: list[Outputs]) -> str:
    (event,) = [event for output in outputs for event in output.events if event.id == "phase_failed"]
    assert event.text.startswith("phase 'weigh' failed: ")
    assert SafetyAction.LAND in {output.action for output in outputs}
    assert SafetyAction.AUTOPILOT_LAND not in {output.action for output in outputs}, "lands under its own control"
    return event.text


def test_a_phase_that_raises_in_the_air_is_named_and_the_vehicle_lands(site: Path) -> None:
    flight = broken(site, "step")
    result = flight.run()
    assert "(lab_weigh.py:" in failed(result.outputs)
    assert not result.crashed and result.outputs[-1].outcome is Outcome.ABORTED


@pytest.mark.parametrize("method", [method for method in RAISES if method != "step"])
def test_whatever_of_a_phase_raises_or_returns_what_cannot_be_flown_it_is_named(
    site: Path, method: str, inputs: list[Inputs]
) -> None:
    """A hold, during the phase, leaves it."""
    core = FlightCore(broken(site, method).config.flight)
    outputs = [core.step(i) for i in inputs]
    if method == "leave":
        outputs.append(core.step(replace(inputs[-1], command=OperatorCommand.HOLD)))
    text = failed(outputs)
    assert ("(lab_weigh.py:" in text) is (method in ("reference", "leave")), text
