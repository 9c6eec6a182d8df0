"""A flight-only installation reports in one line which extra a command needs; flying needs none."""

from __future__ import annotations

import subprocess
import sys

import pytest

from companion import DISTRIBUTION
from companion.cli.main import _normalised, make_parser
from companion.install.extras import missing_extra

EXTRAS = ("mujoco", "joblib", "cma", "scipy", "dask", "distributed", "matplotlib", "aiohttp", "cryptography")


@pytest.mark.parametrize(
    ("words", "what"),
    [
        ("fly m.yaml --sitl", "companion fly --sitl"),
        ("fly m.yaml --sitl=px4", "companion fly --sitl"),
        ("check --sitl", "companion check --sitl"),
        ("sitl", "companion sitl"),
        ("compare --payloads 0.2", "companion compare"),
        ("robustness --draws 1", "companion robustness"),
        ("faults", "companion faults"),
        ("tune", "companion tune"),
        ("faults --list", None),
        ("fly m.yaml", None),
        ("check", None),
        ("schema vehicle", None),
    ],
)
def test_what_lacks_the_world_says_so(words: str, what: str | None) -> None:
    arguments = make_parser().parse_args(_normalised(words.split()))
    said = missing_extra(arguments, here=lambda package: False)
    assert said == (
        None if what is None else f"{what}: the simulated world needs mujoco: pip install '{DISTRIBUTION}[sitl]'"
    )
    assert missing_extra(arguments, here=lambda package: True) is None


@pytest.mark.parametrize(
    ("words", "missing"), [("tune", "the search needs cma"), ("identify log.mcap", "the fit needs scipy")]
)
def test_what_else_a_command_needs_is_named(words: str, missing: str) -> None:
    said = missing_extra(make_parser().parse_args(words.split()), here=lambda package: package == "mujoco")
    assert said == f"companion {words.split()[0]}: {missing}: pip install '{DISTRIBUTION}[sitl]'"


@pytest.mark.parametrize(
    "module", ["companion.flight.main", "companion.guardian.process", "companion.recorder.main", "companion.cli.main"]
)
def test_no_process_of_a_flight_imports_an_extra(module: str) -> None:
    """It starts with all extras forbidden."""
    program = f"import sys; sys.modules.update(dict.fromkeys({EXTRAS!r})); import {module}"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr


def test_the_version_is_printed_without_loading_what_flies() -> None:
    program = "import sys; from companion.cli.main import main\ntry: main(['--version'])\nfinally: print(*sys.modules)"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    loaded = set(ended.stdout.split())
    assert "companion.cli.main" in loaded
    assert loaded.isdisjoint({"pydantic", "yaml", "rich", "msgspec", "numpy", "companion.config", "companion.model"})
