"""How the tests run: shared flights, the same examples for everybody, default signals."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

from tests.support import ROOT


def pytest_of(path: Path) -> tuple[str, ...]:
    return (sys.executable, "-m", "pytest", "-q", "-c", os.devnull, "--rootdir", str(path.parent), str(path))


DRAWS = """
import os, pathlib
from hypothesis import given, strategies as st

if os.environ.get("CI"):
    import many_constants

drawn = []

@given(st.integers(), st.text("dorw 0123456789"), st.floats())
def test_draws(number, text, value):
    drawn.append(ascii((number, text, value)))

def test_write():
    pathlib.Path(os.environ["DRAWN"]).write_text("\\n".join(drawn), encoding="utf-8")
"""


def test_examples_do_not_depend_on_the_environment(tmp_path: Path) -> None:
    """Whatever the environment, the time zone, the hash seed, and the modules imported before."""
    (tmp_path / "test_draws.py").write_text(DRAWS, encoding="utf-8")
    constants = "\n".join(f"A{k} = {k * 7919}; B{k} = 'word {k}'; C{k} = {k}.125" for k in range(100, 400))
    (tmp_path / "many_constants.py").write_text(constants, encoding="utf-8")
    circumstances: list[dict[str, str]] = [
        {"PYTHONHASHSEED": "1"},
        {"PYTHONHASHSEED": "2", "CI": "1", "TZ": "Asia/Kolkata", "LC_ALL": "C", "HOME": "/proc/none"},
    ]
    started = []
    for k, more in enumerate(circumstances):
        path = tmp_path / f"drawn_{k}"
        own = {key: value for key, value in os.environ.items() if key != "CI"}
        environment = {**own, "PYTHONPATH": str(ROOT), "DRAWN": str(path), **more}
        command = (*pytest_of(tmp_path / "test_draws.py"), "-p", "tests.conftest", "-p", "no:cacheprovider")
        started.append(subprocess.Popen(command, cwd=tmp_path, env=environment))
    assert [process.wait() for process in started] == [0, 0]
    drawn = [(tmp_path / f"drawn_{k}").read_text(encoding="utf-8").splitlines() for k in (0, 1)]
    assert len(drawn[0]) == 50
    assert drawn[0] == drawn[1]


def test_children_start_with_default_signal_handling() -> None:
    """Also where these tests were started in the background, by a shell without job control."""
    code = "import signal; print(int(signal.getsignal(signal.SIGINT) is signal.default_int_handler))"
    assert subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.PIPE).stdout == b"1\n"
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == set()
