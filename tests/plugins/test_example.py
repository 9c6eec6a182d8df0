"""The outside package of docs/own-law.md, installed by pip: its own tests and its row in a comparison.

A flight over wires and its log: tests/flights/test_shared_flight.py.
"""

from __future__ import annotations

import ast
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from companion.campaigns.compare.campaign import Compare
from companion.cli.main import main
from companion.model.exit_codes import EXIT_OK
from tests.plugins.installed import on_path
from tests.support import ROOT, SHORT_CATCH

EXAMPLE = ROOT / "examples" / "law"
"""One process, and so pip, once."""
FILES = ("pyproject.toml", "lab_lqr/__init__.py", "lab_lqr/files/controllers/lqr_tuned.yaml", "test_lab_lqr.py")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder into which pip has installed the package."""
    source, site = tmp_path_factory.mktemp("source") / "law", tmp_path_factory.mktemp("site")
    shutil.copytree(EXAMPLE, source)
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
    subprocess.run([*pip, str(source)], check=True, env={**os.environ, "PIP_NO_INDEX": "1"})
    return site


def path_of(site: Path) -> dict[str, str]:
    return {"PYTHONPATH": os.pathsep.join((str(site), str(ROOT)))}


def test_the_page_shows_the_files_as_they_are() -> None:
    page = (ROOT / "docs" / "own-law.md").read_text(encoding="utf-8")
    for name in FILES:
        kind = {".toml": "toml", ".py": "python", ".yaml": "yaml"}[Path(name).suffix]
        assert f"`{name}`:\n\n```{kind}\n{(EXAMPLE / name).read_text(encoding='utf-8')}```\n" in page, name


def test_laws_and_phases_of_others_need_nothing_but_the_public_api() -> None:
    for path in (*EXAMPLE.rglob("*.py"), *(ROOT / "examples" / "phase").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module is not None and node.module.startswith("companion"):
                assert node.module.startswith(("companion.api.", "companion.testing")), f"{path}:{node.lineno}"


def test_its_own_tests_pass(site: Path, tmp_path: Path) -> None:
    shutil.copy(EXAMPLE / "test_lab_lqr.py", tmp_path)
    command = [sys.executable, "-m", "pytest", "-q", "-n0", "-p", "no:cacheprovider"]
    done = subprocess.run(command, cwd=tmp_path, env={**os.environ, **path_of(site)}, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    assert "3 passed" in done.stdout


def test_it_has_a_row_in_the_comparison(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", path_of(site)["PYTHONPATH"])
    monkeypatch.setattr(Compare, "draw", lambda *_: [])  # the plots take longer than the flight
    grid = ["--payloads", "0.1", "--seeds", "1", "--jobs", "1", "--mission", str(SHORT_CATCH)]
    with on_path(site):
        assert main(["compare", "--controllers", "lqr", *grid, "--out", "out", "--json"]) == EXIT_OK
    [row] = json.loads(capsys.readouterr().out)["rows"]
    assert (row["controller"], row["preset"], row["outcome"]) == ("lqr", "tuned", "completed")
    [variant] = json.loads(Path("out/compare.json").read_text(encoding="utf-8"))["settings"]["variants"]
    assert variant["plugin"] == "control law 'lqr' (lab-lqr 0.1.0)"
    assert "lqr/tuned" in Path("out/compare.html").read_text(encoding="utf-8")
