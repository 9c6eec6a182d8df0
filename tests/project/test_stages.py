"""`make test` runs every stage and sums them up; and it draws the same examples for everybody."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.at_a_time import is_taken_within
from tests.low_priority import EQUAL, LOW, OURS, PLACE
from tests.stages import Stage, run_all
from tests.support import DEADLINE_S, ROOT, wait_until

PYTHON = sys.executable.removeprefix(f"{ROOT}/")
OWN = """
import pytest

def test_right(): pass
def test_wrong(): assert False
@pytest.mark.skipif(True, reason="no broker here")
def test_absent(): pass
"""


@pytest.fixture
def tests_file(tmp_path: Path) -> Path:
    path = tmp_path / "test_own.py"
    path.write_text(OWN, encoding="utf-8")
    return path


def pytest_of(path: Path) -> tuple[str, ...]:
    return (sys.executable, "-m", "pytest", "-q", "-c", os.devnull, "--rootdir", str(path.parent), str(path))


def test_a_failed_stage_hides_no_other(tests_file: Path, capfd: pytest.CaptureFixture[str]) -> None:
    broken = (sys.executable, "-c", "raise SystemExit(3)")
    stages = [
        Stage("lint", broken, tests=False),
        Stage("types", (sys.executable, "-c", ""), tests=False),
        Stage("computing", pytest_of(tests_file), tests=True),
        Stage("alone", broken, tests=True),
    ]
    assert run_all(stages) == 1
    lines = capfd.readouterr().out.splitlines()
    assert lines[-1] == "2 passed, 3 failed, 1 skipped"
    table = [line.split() for line in lines[lines.index("") :]]
    assert [words[:5] for words in table if words[:1] == ["computing"]] == [["computing", "FAILED", "1", "1", "1"]]
    assert [words[1] for words in table if words[:1] in (["lint"], ["types"], ["alone"])] == [
        "FAILED",
        "passed",
        "FAILED",
    ]
    assert "skipped: 1 x no broker here" in lines
    again = lines[lines.index("failed; run one again:") + 1 : -1]
    assert again == [
        f"  {PYTHON} -c 'raise SystemExit(3)'",
        f"  {PYTHON} -m pytest -n0 test_own.py::test_wrong",
        f"  {PYTHON} -m tests.stages alone",
    ]


def test_all_green_is_exit_0(capfd: pytest.CaptureFixture[str]) -> None:
    assert run_all([Stage("types", (sys.executable, "-c", ""), tests=False)]) == 0
    assert capfd.readouterr().out.splitlines()[-1] == "1 passed, 0 failed, 0 skipped"


@pytest.mark.parametrize("ours", [False, True])
def test_a_stage_runs_beside_the_next_ones(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *, ours: bool
) -> None:
    """In a session of its own, with the lowest priority in it, and among sessions where the kernel has groups of them; in our session
    beside a foreign program of ours that has even less, and then what has to be in time has its own. Its output comes whole.
    """
    if ours:
        monkeypatch.setenv(PLACE, OURS)
    else:
        monkeypatch.delenv(PLACE, raising=False)
    met = tmp_path / "met"
    meets = f"import os, pathlib; pathlib.Path({str(met)!r}).write_text(str(os.getsid(0) == os.getpid()))"
    waits = f"import os, pathlib, time\nwhile not pathlib.Path({str(met)!r}).exists(): time.sleep(0.01)\n"
    waits += "print(os.getsid(0) == os.getpid(), os.nice(0))\n"
    waits += "path = pathlib.Path('/proc/self/autogroup'); print(path.read_text().split()[-1] if path.exists() else 19)"
    stages = [
        Stage("computing", (sys.executable, "-c", waits), tests=False, beside=True),
        Stage("types", (sys.executable, "-c", meets), tests=False),
    ]
    assert run_all(stages) == 0
    assert met.read_text(encoding="utf-8") == str(ours)
    out = capfd.readouterr().out
    group = Path("/proc/self/autogroup")
    among = group.read_text(encoding="ascii").split()[-1] if ours and group.exists() else "19"
    assert f"=== computing:\n{not ours} {min(19, os.nice(0) + (LOW if ours else 19))}\n{among}\n" in out
    assert out.index("=== types") < out.index("=== computing:\n")


GROUP = """
import os, time
import pytest

@pytest.mark.xdist_group("a world")
@pytest.mark.parametrize("number", range(3))
def test_shares(number):
    time.sleep(0.2)
    with open("workers", "a") as file:
        print(os.environ["PYTEST_XDIST_WORKER"], file=file)
"""


def test_tests_of_a_group_share_one_worker(tmp_path: Path) -> None:
    """And with it what their fixtures have made: pytest-xdist loses its groups, unnoticed, with a pytest that it does not know."""
    path = tmp_path / "test_group.py"
    path.write_text(GROUP, encoding="utf-8")
    subprocess.run((*pytest_of(path), "-n", "2", "--dist", "loadgroup"), cwd=tmp_path, check=True)
    assert len(set((tmp_path / "workers").read_text(encoding="utf-8").splitlines())) == 1


@pytest.mark.parametrize("equal", [False, True])
def test_workers_have_sessions_of_their_own_where_these_share_the_processors(tmp_path: Path, *, equal: bool) -> None:
    path = tmp_path / "test_session.py"
    path.write_text("import os\ndef test_session():\n    open('session', 'w').write(f'{os.getsid(0)} {os.getpid()}')\n")
    own = {key: value for key, value in os.environ.items() if key != PLACE}
    environment = {**own, "PYTHONPATH": str(ROOT), **({PLACE: EQUAL} if equal else {})}
    command = (*pytest_of(path), "-p", "tests.low_priority", "-n", "1")
    with subprocess.Popen(command, cwd=tmp_path, env=environment, start_new_session=True) as process:
        assert process.wait() == 0
    session, worker = (tmp_path / "session").read_text(encoding="utf-8").split()
    assert int(session) == (int(worker) if equal else process.pid)


def test_a_program_that_takes_a_core_is_found_in_its_session() -> None:
    with subprocess.Popen((sys.executable, "-c", "while True: pass"), start_new_session=True) as foreign:
        try:
            wait_until(lambda: is_taken_within(foreign.pid, above=-21), lambda: "it used less than a quarter of a core")
            assert not is_taken_within(foreign.pid, above=19)
        finally:
            foreign.kill()


@pytest.mark.parametrize(("beside", "place"), [(False, None), (True, None), (False, OURS), (True, OURS)])
def test_ctrl_c_lets_the_stage_end_in_order(tmp_path: Path, *, beside: bool, place: str | None) -> None:
    """The stage takes two seconds to end."""
    begun, ended = tmp_path / "begun", tmp_path / "ended"
    slow = "import pathlib, signal, sys, time\ntry:\n    pathlib.Path(sys.argv[1]).touch(); signal.pause()\nfinally:\n"
    slow += "    time.sleep(2.0); pathlib.Path(sys.argv[2]).touch()\n"
    stage = f"Stage('computing', (sys.executable, '-c', {slow!r}, {str(begun)!r}, {str(ended)!r}), tests=False, beside={beside})"
    other = "Stage('types', (sys.executable, '-c', 'import signal; signal.pause()'), tests=False)"
    code = f"import signal, sys; from tests.stages import *; sys.exit(run_all([{stage}, {other}]))"
    environment = {
        **{key: value for key, value in os.environ.items() if key != PLACE},
        **({PLACE: place} if place else {}),
    }
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, start_new_session=True) as process:
        assert process.stdout is not None
        wait_until(begun.exists, lambda: "the stage has not begun")
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(DEADLINE_S) == 130
        assert process.stdout.read().splitlines()[-1] == b"0 passed, 0 failed, 0 skipped"
    assert ended.exists()


DRAWS = """
import os, pathlib
from hypothesis import given, strategies as st

if os.environ.get("CI"):
    import many_constants

drawn = []

@given(st.integers(), st.text(), st.floats())
def test_draws(number, text, value):
    drawn.append(ascii((number, text, value)))

def test_write():
    pathlib.Path(os.environ["DRAWN"]).write_text("\\n".join(drawn), encoding="utf-8")
"""


def test_everybody_draws_the_same_examples(tmp_path: Path) -> None:
    """Whatever the environment, the time zone, the hash seed, and the modules imported before."""
    (tmp_path / "test_draws.py").write_text(DRAWS, encoding="utf-8")
    constants = "\n".join(f"A{k} = {k * 7919}; B{k} = 'word {k}'; C{k} = {k}.125" for k in range(100, 400))
    (tmp_path / "many_constants.py").write_text(constants, encoding="utf-8")
    circumstances: list[dict[str, str]] = [
        {"PYTHONHASHSEED": "1"},
        {"PYTHONHASHSEED": "2", "CI": "1", "TZ": "Asia/Kolkata", "LC_ALL": "C", "HOME": "/proc/none"},
    ]
    drawn = []
    for k, more in enumerate(circumstances):
        path = tmp_path / f"drawn_{k}"
        own = {key: value for key, value in os.environ.items() if key != "CI"}
        environment = {**own, "PYTHONPATH": str(ROOT), "DRAWN": str(path), **more}
        command = (*pytest_of(tmp_path / "test_draws.py"), "-p", "tests.conftest", "-p", "no:cacheprovider")
        subprocess.run(command, cwd=tmp_path, env=environment, check=True)
        drawn.append(path.read_text(encoding="utf-8").splitlines())
    assert len(drawn[0]) == 50
    assert drawn[0] == drawn[1]


def test_children_start_with_default_signal_handling() -> None:
    """Also where these tests were started in the background, by a shell without job control."""
    code = "import signal; print(int(signal.getsignal(signal.SIGINT) is signal.default_int_handler))"
    assert subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.PIPE).stdout == b"1\n"
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == set()
