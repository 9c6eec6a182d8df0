"""The wheel contains every file that the program reads, and flies from an empty folder without the repository."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from companion import DISTRIBUTION, __version__
from companion.cli.main import main
from companion.config.yaml_strict import read_document
from tests.support import ROOT

PACKAGES = ("companion", "sitl")
FLIGHT = """
import companion
from companion.cli.main import main
from companion.sitl_config.loader import load_sitl
from sitl.fast.loop import FastFlight
assert main(["check", "--plan-only"]) == 0
assert main(["init"]) == 0
assert main(["check", "configs/missions/hover.yaml", "--plan-only"]) == 0
flown = FastFlight(load_sitl("hover", world="lab")).run(limit_s=1.0)
print(companion.__file__, len(flown.outputs))
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, unpacked."""
    source, built = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("built")
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", str(built)]
    subprocess.run([*command, str(source)], check=True, env={**os.environ, "PIP_NO_INDEX": "1"})
    (file,) = built.glob("*.whl")
    with zipfile.ZipFile(file) as archive:
        archive.extractall(built / "files")
    return built / "files"


def test_the_wheel_contains_every_file_of_the_packages(wheel: Path) -> None:
    def files(root: Path) -> set[str]:
        walked = (found for name in PACKAGES for found in os.walk(root / name, followlinks=True))
        paths = (Path(folder, name) for folder, _, names in walked for name in names)
        return {str(path.relative_to(root)) for path in paths if path.parent.name != "__pycache__"}

    assert files(wheel) == files(ROOT)
    assert "companion/config/files/missions/catch.yaml" in files(wheel)


def test_wheel_command_citation_and_changelog_name_one_version(wheel: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (metadata,) = wheel.glob("*.dist-info/METADATA")
    lines = metadata.read_text(encoding="utf-8").splitlines()
    assert {f"Name: {DISTRIBUTION}", f"Version: {__version__}"} <= set(lines)
    with pytest.raises(SystemExit, match="0"):
        main(["--version"])
    assert capsys.readouterr().out == f"companion {__version__}\n"
    assert read_document(ROOT / "CITATION.cff").data["version"] == __version__
    assert f"\n## {__version__} - " in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_the_installed_program_needs_no_repository(wheel: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-P", "-c", FLIGHT],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(wheel)},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    path, ticks = done.stdout.split()[-2:]
    assert Path(path).is_relative_to(wheel)
    assert int(ticks) >= 100
    assert {path.name for path in tmp_path.iterdir()} == {"configs"}
