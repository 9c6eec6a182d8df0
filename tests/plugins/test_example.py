"""The outside packages of examples/ with control laws, installed by pip: their own tests, and the row of one in a comparison.

A flight over wires and its log: tests/flights/test_shared_flight.py.
"""

from __future__ import annotations

import ast
import json
import os
import shutil
import subprocess
import sys
from math import cos, sin
from pathlib import Path

import pytest
from msgspec.structs import replace

from companion.campaigns.compare.campaign import Compare
from companion.cli.main import main
from companion.config.controller import AdaptiveConfig
from companion.config.loader import load_flight
from companion.control.trial import at_rest, build_law, hover
from companion.model.algebra import plus, scaled
from companion.model.constants import TICK_PERIOD_S
from companion.model.exit_codes import EXIT_OK
from companion.model.frames import quat_from_euler_zyx
from tests.plugins.installed import on_path
from tests.support import ROOT, SHORT_CATCH

EXAMPLE, BASELINES = ROOT / "examples" / "law", ROOT / "examples" / "baselines"
FILES = ("pyproject.toml", "lab_lqr/__init__.py", "lab_lqr/files/controllers/lqr_tuned.yaml", "test_lab_lqr.py")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder into which pip has installed the packages, in one process."""
    sources, site = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("site")
    for package in (EXAMPLE, BASELINES):
        shutil.copytree(package, sources / package.name)
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
        "--target",
        str(site),
    ]
    subprocess.run([*pip, *map(str, sources.iterdir())], check=True, env={**os.environ, "PIP_NO_INDEX": "1"})
    return site


def path_of(site: Path) -> dict[str, str]:
    return {"PYTHONPATH": os.pathsep.join((str(site), str(ROOT)))}


def test_the_page_shows_the_files_as_they_are() -> None:
    page = (ROOT / "docs" / "own-law.md").read_text(encoding="utf-8")
    for name in FILES:
        kind = {".toml": "toml", ".py": "python", ".yaml": "yaml"}[Path(name).suffix]
        assert f"`{name}`:\n\n```{kind}\n{(EXAMPLE / name).read_text(encoding='utf-8')}```\n" in page, name


def test_laws_and_phases_of_others_need_nothing_but_the_public_api() -> None:
    for path in [path for folder in (EXAMPLE, BASELINES, ROOT / "examples/phase") for path in folder.rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module is not None and node.module.startswith("companion"):
                assert node.module.startswith(("companion.api.", "companion.testing")), f"{path}:{node.lineno}"


def test_their_own_tests_pass(site: Path, tmp_path: Path) -> None:
    for test in (EXAMPLE / "test_lab_lqr.py", BASELINES / "test_baselines.py"):
        shutil.copy(test, tmp_path)
    short = f"partial(sitl.testing.check_catch, mission={str(SHORT_CATCH)!r})"
    text = f"from functools import partial\nimport sitl.testing\nsitl.testing.check_catch = {short}\n"
    (tmp_path / "conftest.py").write_text(text)
    # PID and L1 differ from each other by their adaptation, and from the law of the companion by less; LQR flies in the comparison.
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-n0",
        "-p",
        "no:cacheprovider",
        "-k",
        "not (catch and (pid or l1 or lqr))",
    ]
    done = subprocess.run(command, cwd=tmp_path, env={**os.environ, **path_of(site)}, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    assert "9 passed" in done.stdout


def test_the_baseline_pid_is_recommended_without_what_adapts_in_norms_and_in_the_arm(site: Path) -> None:
    off = ("controller.rho_max=1.0e-9", "controller.moment_rate=0", "controller.friction_rate=0")
    with on_path(site):
        recommended, pid = load_flight("catch", None, "adaptive", "recommended", off), load_flight("catch", None, "pid")
        mass_kg, c = recommended.vehicle.airframe.mass_kg, recommended.controller
        assert isinstance(c, AdaptiveConfig)
        rows = [*zip(c.inertia_md[:3], c.lambda_gain[:3], c.phi[:3], c.load_rate_xyz, strict=True)]
        gains = {
            "position_kd_xyz": tuple([(lambda_ + m_d * phi) / mass_kg for m_d, lambda_, phi, _ in rows]),
            "position_kp_xyz": tuple([(lambda_ * phi + gamma) / mass_kg for _, lambda_, phi, gamma in rows]),
            "position_ki_xyz": tuple([gamma * phi / mass_kg for _, _, phi, gamma in rows]),
        }
        for key, exact in gains.items():
            assert getattr(pid.controller, key) == pytest.approx(exact, rel=1e-5), key
        laws = [build_law(c, recommended.vehicle), build_law(pid.controller.with_gains(gains), pid.vehicle)]
        arm, arm_rate, e, e_dot = (1.7, 1.0), (0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        for tick in range(2000):
            t = tick * TICK_PERIOD_S
            state = replace(
                at_rest(arm),
                position_world_m=(e[0], e[1], 1.0 + e[2]),
                velocity_world_m_s=e_dot,
                arm_rate_rad_s=arm_rate,
                attitude_wxyz=quat_from_euler_zyx(0.02 * sin(t), 0.03 * sin(2.0 * t), 0.0),
                force_ext_world_n=(0.3 * sin(3.0 * t), 0.2, -1.0),
            )
            reference = replace(
                hover((1.75, 1.05)),
                acceleration_world_m_s2=(0.3, 0.2 * sin(t), 0.1),
                arm_acceleration_rad_s2=(0.5, -0.5),
            )
            one, other = [law.step(TICK_PERIOD_S, state, reference, 1.0) for law in laws]
            assert not any(one.log.saturated)
            assert other.collective_n == pytest.approx(one.collective_n, abs=1e-6)
            assert other.attitude_wxyz == pytest.approx(one.attitude_wxyz, abs=1e-7)
            assert other.arm_torque_nm == pytest.approx(one.arm_torque_nm, abs=1e-7)
            e = plus(e, scaled(e_dot, TICK_PERIOD_S))
            e_dot = (0.05 * sin(2.0 * t), 0.05 * sin(3.0 * t), 0.04 * cos(2.0 * t))
            arm_rate = (0.2 * sin(4.0 * t), 0.1 * cos(3.0 * t))
            arm = (arm[0] + TICK_PERIOD_S * arm_rate[0], arm[1] + TICK_PERIOD_S * arm_rate[1])


def test_it_has_a_row_in_the_comparison(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", path_of(site)["PYTHONPATH"])
    monkeypatch.setattr(Compare, "draw", lambda *_: [])  # the plots take longer than the flight
    grid = ["--world", "ideal", "--payloads", "0.2", "--seeds", "1", "--jobs", "1", "--mission", str(SHORT_CATCH)]
    with on_path(site):
        assert main(["compare", "--controllers", "lqr", *grid, "--out", "out", "--json"]) == EXIT_OK
    [row] = json.loads(capsys.readouterr().out)["rows"]
    assert (row["controller"], row["preset"], row["outcome"], row["caught"]) == ("lqr", "tuned", "completed", True)
    [variant] = json.loads(Path("out/compare.json").read_text(encoding="utf-8"))["settings"]["variants"]
    assert variant["plugin"] == "control law 'lqr' (lab-lqr 0.1.0)"
    assert "lqr/tuned" in Path("out/compare.html").read_text(encoding="utf-8")
