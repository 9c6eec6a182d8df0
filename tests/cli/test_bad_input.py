"""Bad command lines and bad files: exit 2, one useful line per problem, nothing started, nothing left.

Through the command's entry point, in this process; a few of each sort as a user's shell starts it.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from companion.cli.campaign import reserved_folder
from companion.cli.main import main
from companion.model.exit_codes import EXIT_ABORTED, EXIT_BAD_INPUT, EXIT_OK
from companion.runtime.console import SteadyStream
from tests.analysis.synthetic_flight import record_flight
from tests.support import CATCH, ROOT, Ended, Sandbox, sandbox_in

VEHICLE = ROOT / "configs/vehicles/tarot650_2r.yaml"
FLY = ("fly", "mission.yaml", "--sitl", "--out", "out")


@pytest.fixture
def sandbox(tmp_path: Path) -> Iterator[Sandbox]:
    """The catch and its vehicle as files that a test may change."""
    with sandbox_in(tmp_path) as sandbox:
        mission = CATCH.read_text(encoding="utf-8").replace("../vehicles/tarot650_2r.yaml", "vehicle.yaml")
        (sandbox.cwd / "mission.yaml").write_text(mission, encoding="utf-8")
        (sandbox.cwd / "vehicle.yaml").write_text(VEHICLE.read_text(encoding="utf-8"), encoding="utf-8")
        yield sandbox


def files_in(folder: Path) -> dict[str, bytes | None]:
    return {str(path.relative_to(folder)): None if path.is_dir() else path.read_bytes() for path in folder.rglob("*")}


Command = Callable[..., Ended]


@pytest.fixture
def companion(sandbox: Sandbox, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Command:
    """The command in this process, at home in the sandbox; what it would start carries the sandbox's mark."""
    monkeypatch.chdir(sandbox.cwd)
    for name, value in sandbox.environment.items():
        monkeypatch.setenv(name, value)

    def run(*arguments: str) -> Ended:
        capfd.readouterr()
        try:
            code = main(arguments)
        except SystemExit as left:
            code = left.code if isinstance(left.code, int) else -1
        out, err = capfd.readouterr()
        return Ended(code, out, err)

    return run


def assert_refused(sandbox: Sandbox, run: Command, arguments: tuple[str, ...], patterns: tuple[str, ...]) -> None:
    """Exit 2 with exactly these lines; the sandbox holds the same files as before and no process."""
    before = files_in(sandbox.cwd)
    ended = run(*arguments)
    sandbox.assert_nobody_left()
    assert_lines(ended, patterns)
    assert files_in(sandbox.cwd) == before


def assert_lines(ended: Ended, patterns: tuple[str, ...]) -> None:
    assert "Traceback" not in ended.err
    assert len(ended.err_lines) == len(patterns), ended.err
    for line, pattern in zip(ended.err_lines, patterns, strict=True):
        assert re.search(pattern, line), (pattern, line)
    assert ended.out == ""
    assert ended.code == EXIT_BAD_INPUT


COMMAND_LINES: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "no command": ((), (r"^companion: .*COMMAND.*see companion --help",)),
    "unknown command": (("flyy",), (r"^companion: .*'flyy'.*'fly'",)),
    "no mission": (("fly",), (r"^companion fly: .*mission.*see companion fly --help",)),
    "unknown option": ((*FLY, "--bogus"), (r"^companion fly: .*--bogus.*see companion fly --help",)),
    "abbreviated option": ((*FLY, "--pres", "paper"), (r"^companion fly: .*--pres",)),
    "option before the mission": (("fly", "--sitl", "mission.yaml", "--preset", "papr"), (r"--preset papr: .*paper",)),
    "two missions": ((*FLY, "other.yaml"), (r"^companion fly: .*other\.yaml",)),
    "no such built-in mission": (
        ("fly", "cath", "--sitl"),
        (r"^mission cath: expected carry, catch, circuit, .* or a file, found neither \(did you mean catch\?\)$",),
    ),
    "copies over existing files": (("init", "."), (r"^companion init: \. exists; .*nothing was written$",)),
    "unknown world": (("fly", "mission.yaml", "--sitl=moon"), (r"^companion fly: argument --sitl: expected --sitl",)),
    "bad preset": ((*FLY, "--preset", "papr"), (r"--preset papr: .*paper, .*recommended",)),
    "negative seed": ((*FLY, "--seed=-1"), (r"^companion fly: argument --seed: expected a whole number from 0",)),
    "model error that is too large": (
        ("compare", "--model-error", "0,0.4"),
        (r"--model-error: expected comma-separated fractions from 0 to 0\.3",),
    ),
    "model error set for a comparison": (
        ("compare", "--set", "world.model_error=0.1"),
        (r"--set world\.model_error: the grid sets this key; use --model-error$",),
    ),
    "set without a value": ((*FLY, "--set"), (r"^companion fly: argument --set: expected",)),
    "waypoint outside of the room": (
        (*FLY, "--set", "mission.phases[2].to_m=[2.0, 0, 1]"),
        (
            r"phase 'catch' flies too fast",
            r"phase 'catch' could not stop within the tether sphere",
            r"mission\.yaml:\d+:\d+: .*phase 'catch' leaves the room.*x = 2\.49 m.*inwards",
        ),
    ),
    "Foxglove without a port": (
        (*FLY, "--foxglove=localhost"),
        (r"^--set vehicle\.ground\.foxglove: expected HOST:PORT of this computer, such as .*got 'localhost'",),
    ),
    "Foxglove at an address of IPv6 that nobody has": (
        (*FLY, "--foxglove", "[2001:db8::1]:8765"),
        (
            r"^vehicle\.ground\.foxglove \(--foxglove\) is \[2001:db8::1\]:8765, but .*; give another: --foxglove HOST:PORT$",
        ),
    ),
    "Foxglove on another computer": (
        (*FLY, "--foxglove", "192.0.2.1:8765"),
        (
            r"^vehicle\.ground\.foxglove \(--foxglove\) is 192\.0\.2\.1:8765, but .*; give another: --foxglove HOST:PORT$",
        ),
    ),
    "out is a file": (("fly", "mission.yaml", "--sitl", "--out", "vehicle.yaml"), (r"--out vehicle\.yaml: is a file",)),
    # The one folder that neither root nor anybody else can write to.
    "out cannot be written": (
        ("fly", "mission.yaml", "--sitl", "--out", "/proc"),
        (r"--out /proc: .*; choose a writable fold",),
    ),
    "animation of two flights": (
        ("report", "a.mcap", "b.mcap", "--gif", "catch.gif"),
        (r"^companion report: --gif: expected one log, got 2$",),
    ),
    "folder of a flight in place of its log": (
        ("replay", "."),
        (r"^\.: is a folder; expected a flight log, such as flight\.mcap$",),
    ),
    "copies where nothing can be written": (
        ("init", "/proc/configs"),
        (r"^companion init: /proc/configs: cannot be written: No such file or directory$",),
    ),
    "schema of nothing": (("schema", "moon"), (r"^companion schema: .*'moon'.*'mission'",)),
    "a world of a bad mission": (("sitl", "nofile.yaml"), (r"^nofile\.yaml: no such file$",)),
}


FROM_A_SHELL = ("no command", "a world of a bad mission")


@pytest.mark.parametrize("case", [case for case in COMMAND_LINES if case != "a world of a bad mission"])
def test_bad_command_line(sandbox: Sandbox, companion: Command, case: str) -> None:
    assert_refused(sandbox, companion, *COMMAND_LINES[case])


@pytest.mark.parametrize("case", FROM_A_SHELL)
def test_bad_command_line_from_a_shell(sandbox: Sandbox, case: str) -> None:
    assert_refused(sandbox, sandbox.run, *COMMAND_LINES[case])


def replaced(old: str, new: str) -> Callable[[str], str]:
    def edit(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return edit


BAD_FILES: dict[str, tuple[str, Callable[[str], str], tuple[str, ...]]] = {
    "unknown key": (
        "mission.yaml",
        replaced("yaw_deg: 0.0", "yaw_degg: 0.0"),
        (r"^mission\.yaml:\d+:3: start\.yaw_degg: unknown key; did you mean yaw_deg\?",),
    ),
    "two problems, two lines": (
        "mission.yaml",
        lambda text: text.replace("height_m: 1.0", "height_m: tall", 1).replace("yaw_deg: 0.0", "yaw: 0.0", 1),
        (r"start\.yaw: unknown key; write yaw_deg", r"phases\[0\]\.height_m: expected a number.*\"tall\""),
    ),
}


@pytest.mark.parametrize(
    ("command", "case"), [*(("fly", case) for case in BAD_FILES), ("check", "two problems, two lines")]
)
def test_bad_file(sandbox: Sandbox, companion: Command, case: str, command: str) -> None:
    name, edit, patterns = BAD_FILES[case]
    path = sandbox.cwd / name
    path.write_text(edit(path.read_text(encoding="utf-8")), encoding="utf-8")
    assert_refused(sandbox, companion, FLY if command == "fly" else ("check", "mission.yaml", "--plan-only"), patterns)


def test_a_foxglove_port_in_use_is_refused_before_anything_starts(sandbox: Sandbox, companion: Command) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        address = f"127.0.0.1:{other.getsockname()[1]}"
        refusal = (rf"^vehicle\.ground\.foxglove \(--foxglove\) is {address}, but another program uses the port;",)
        assert_refused(sandbox, companion, (*FLY, "--foxglove", address), refusal)


def test_a_folder_that_holds_a_flight_is_not_touched(sandbox: Sandbox, companion: Command) -> None:
    (sandbox.cwd / "out").mkdir()
    (sandbox.cwd / "out/flight.mcap").write_bytes(b"an earlier flight")
    assert_refused(sandbox, companion, FLY, (r"--out out: already contains flight\.mcap; choose another folder",))


def test_a_folder_of_a_flight_in_progress_is_refused(sandbox: Sandbox, companion: Command) -> None:
    with reserved_folder("fly", "out", Path("new"), "flight.mcap"):
        refusal = (r"^companion fly: --out out: another command writes to it now; choose another folder$",)
        assert_refused(sandbox, companion, (*FLY, "--out", "out"), refusal)


def test_flights_that_begin_in_the_same_second_have_folders_of_their_own(tmp_path: Path) -> None:
    default = tmp_path / "flights" / "20261125-093743-catch"
    with (
        reserved_folder("fly", None, default, "flight.mcap") as first,
        reserved_folder("fly", None, default, "flight.mcap") as second,
    ):
        assert (first.name, second.name) == ("20261125-093743-catch", "20261125-093743-catch-2")
    with reserved_folder("fly", str(first), default, "flight.mcap"):
        pass


def test_the_good_files_that_the_bad_ones_are_made_of_pass(sandbox: Sandbox) -> None:
    ended = sandbox.run("check", "mission.yaml", "--plan-only", "--set", "world.payload_kg=0.1", "world.seed=2")
    assert (ended.code, ended.err) == (EXIT_OK, "")
    assert "can be flown" in ended.out


def test_the_plan_check_shows_where_each_pose_puts_the_net(capsys: pytest.CaptureFixture[str]) -> None:
    straight = ("vehicle.arm.poses={unfolded: [90, 0]}", "vehicle.arm.link_lengths_m=[0.2, 0.22]")
    assert main(["check", "hover", "--plan-only", "--set", *straight]) == EXIT_OK
    line = "pose unfolded, 90, 0 deg: the net is +0.00 m forward, +0.00 m left and -0.47 m up from the body origin"
    assert line in capsys.readouterr().out


def test_a_delay_of_the_servo_bus_is_refused_in_simulated_time(companion: Command) -> None:
    ended = companion(*FLY, "--set", "world.faults=[{kind: bus_delay, t_s: 1.0}]")
    assert ended.code == EXIT_BAD_INPUT
    assert "bus_delay: the servo bus takes no time in simulated time; add --real-time" in ended.err


def test_the_line_that_a_copy_of_the_files_suggests_flies_from_any_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["init", str(tmp_path / "my files")]) == EXIT_OK
    line = capsys.readouterr().out.splitlines()[-1].removeprefix("try: ")
    assert shlex.split(line) == ["companion", "fly", str(tmp_path / "my files/missions/catch.yaml"), "--sitl"]


@pytest.mark.parametrize(
    ("words", "first", "second"),
    [
        ("fly catch --sitl --seed 1 --set world.seed=2", "--seed 1", "--set world.seed=2"),
        ("fly catch --sitl --seed 1 --seed 2", "--seed 1", "--seed 2"),
        ("fly catch --mqtt off --set vehicle.ground.mqtt.url=mqtt://h", "--mqtt off", "--set vehicle.ground.mqtt.url=mqtt://h"),
        ("fly catch --wait-for-start --set mission.start.takeoff=auto", "--wait-for-start", "--set mission.start.takeoff=auto"),
        ("check catch --vehicle hexa_2r --set mission.vehicle=hexa", "--vehicle hexa_2r", "--set mission.vehicle=hexa"),
        ("check catch --preset paper --set mission.controller={law:csc}", "--preset paper", "--set mission.controller={law:csc}"),
        ("robustness catch --controller csc --set mission.controller.law=psc", "--controller csc", "--set mission.controller.law=psc"),
        ("robustness catch --model-error 0.1 --set world.model_error=0.2", "--model-error 0.1", "--set world.model_error=0.2"),
        ("team check carry --seed 1 --set world.seed=2", "--seed 1", "--set world.seed=2"),
    ],
)  # fmt: skip
def test_two_values_of_one_setting_are_refused(
    words: str,
    first: str,
    second: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words.split()) == EXIT_BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    text = f"{first} and {second} give one setting different values; leave one of them out"
    assert line == f"companion {words.split()[0]}: {text}"


def test_an_option_and_a_set_of_the_same_value_are_accepted() -> None:
    same = ["--seed", "1", "--set", "world.seed=1", "--vehicle", "hexa_2r", "--set", "mission.vehicle=hexa_2r"]
    assert main(["check", "hover", "--plan-only", *same]) == EXIT_OK


def assert_cannot_be_written(command: str, code: int, err: str) -> None:
    assert code == EXIT_BAD_INPUT
    name = command.partition(" ")[0]
    assert err.splitlines() == [f"companion {name}: standard output cannot be written: No space left on device"]


@pytest.mark.parametrize(
    ("command", "buffering"),
    [
        ("schema mission", 1),
        ("export flight.mcap --format csv", 1),
        ("team check carry --sitl", 1),
        ("fly --help", 1),
        ("fly --help", -1),
    ],
)
def test_output_that_cannot_be_written_is_one_line(
    command: str, buffering: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With a buffer of a line, as PYTHONUNBUFFERED makes it, and with the usual one."""
    monkeypatch.chdir(tmp_path)
    if command.startswith("export"):
        pytest.importorskip("pandas")
        record_flight(tmp_path / "flight.mcap", end_s=1.0)
    with open("/dev/full", "w", buffering=buffering) as full:
        monkeypatch.setattr(sys, "stdout", full)
        code = main(command.split())
    assert_cannot_be_written(command, code, capsys.readouterr().err)


@pytest.mark.parametrize("unbuffered", ["1", ""])
def test_output_of_a_program_that_cannot_be_written_is_one_line(unbuffered: str, tmp_path: Path) -> None:
    with open("/dev/full", "w") as full:
        ended = subprocess.run(
            [sys.executable, "-P", "-m", "companion", "faults", "--list"],
            stdout=full, stderr=subprocess.PIPE, text=True, cwd=tmp_path, env={**os.environ, "PYTHONUNBUFFERED": unbuffered},
        )  # fmt: skip
    assert_cannot_be_written("faults", ended.returncode, ended.stderr)


def test_a_completed_flight_stays_completed_without_room_for_its_output(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit code 2 says that nothing has moved."""

    def flown(_: argparse.Namespace) -> int:
        SteadyStream(sys.stdout).write("completed\n" * 10_000)
        return EXIT_OK

    monkeypatch.setattr("companion.cli.flight._fly", flown)
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert main(["fly", "hover", "--sitl"]) == EXIT_OK
    assert "standard output cannot be written" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("mission", "closed", "expected"),
    [
        ("mission.yaml", ">&-", (EXIT_OK, "")),
        ("none.yaml", "2>&-", (EXIT_BAD_INPUT, "")),
        ("none.yaml", "<&- >&-", (EXIT_BAD_INPUT, "none.yaml: no such file\n")),
    ],
)
def test_a_command_runs_with_a_standard_stream_closed(
    sandbox: Sandbox, mission: str, closed: str, expected: tuple[int, str]
) -> None:
    ended = subprocess.run(
        ["sh", "-c", f"{shlex.quote(sys.executable)} -P -m companion check --plan-only {mission} {closed}"],
        capture_output=True, text=True, cwd=sandbox.cwd, env=sandbox.environment,
    )  # fmt: skip
    assert ended.stdout == ""
    assert (ended.returncode, ended.stderr) == expected


def test_characters_that_the_encoding_of_standard_output_lacks_are_escaped(tmp_path: Path) -> None:
    ended = subprocess.run(
        [sys.executable, "-P", "-m", "companion", "init", "Fläche"],
        capture_output=True, text=True, cwd=tmp_path, env={**os.environ, "PYTHONIOENCODING": "ascii"},
    )  # fmt: skip
    assert (ended.returncode, ended.stderr) == (EXIT_OK, "")
    assert ended.stdout.startswith(r"Fl\xe4che: controllers, ")


def test_an_interrupt_while_modules_are_imported_is_one_line(
    companion: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(name: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("companion.cli.main.importlib.import_module", interrupted)
    assert companion("replay", "flight.mcap") == Ended(EXIT_ABORTED, "", "companion replay: interrupted\n")


_INTERRUPTED_IMPORT = """
import sys

class Interrupted:
    def find_spec(self, name, *_):
        if name == "companion.cli.main":
            raise KeyboardInterrupt

sys.meta_path.insert(0, Interrupted())
"""


def test_an_interrupt_while_the_command_itself_is_imported_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(_INTERRUPTED_IMPORT, encoding="utf-8")
    ended = subprocess.run(
        [sys.executable, "-m", "companion", "--help"],
        capture_output=True, text=True, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(tmp_path)},
    )  # fmt: skip
    assert (ended.returncode, ended.stdout, ended.stderr) == (EXIT_ABORTED, "", "companion --help: interrupted\n")
