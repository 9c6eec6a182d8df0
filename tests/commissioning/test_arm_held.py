"""`companion arm jog`, and Ctrl-C in every tool that lasts, in one simulated world where somebody holds the arm while it is limp.

Each test finds the arm where the one before has left it.
"""

from __future__ import annotations

import os
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest

from companion.commissioning.arm.scan import scan
from companion.config.loader import load_vehicle
from companion.model.exit_codes import EXIT_ABORTED, EXIT_BAD_INPUT, EXIT_OK, EXIT_REFUSED
from tests.commissioning.arm_rig import FILES, HAND, SHIPPED, Rig, rig
from tests.support import DEADLINE_S

JOINTS = load_vehicle(SHIPPED).arm.joints


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """Somebody holds the arm while it is limp."""
    with rig(tmp_path_factory.mktemp("held"), HAND) as one:
        yield one


def test_jog_moves_one_joint_and_stays_within_the_limits(held: Rig) -> None:
    code, done = held.json("jog", "--joint", "2", "--to", "120", "--yes", process=True)
    assert (code, done["stopped"]) == (EXIT_OK, "")
    assert done["angle_deg"] == pytest.approx([165.0, 120.0], abs=1.0)
    # What a late control on a busy computer adds to the load is not the tool's.
    assert all(0.0 <= load_nm < joint.torque_max_nm for load_nm, joint in zip(done["load_max_nm"], JOINTS, strict=True))
    for words, told in (
        (("--joint", "2", "--to", "149"), "expected -7 to 147 deg"),
        (("--joint", "2"), "--joint N and --to DEG belong together"),
        ((), "no terminal to read keys from"),
        (("--joint", "3", "--to", "0"), "expected 1 to 2"),
    ):
        ended = held.run("jog", *words, "--yes")
        assert ended.code == EXIT_BAD_INPUT and told in ended.err and len(ended.err_lines) == 1, ended
    ended = held.run("jog", "--joint", "2", "--to", "100")
    assert ended.code == EXIT_BAD_INPUT and "add --yes" in ended.err


def test_keys_at_a_terminal_move_the_arm_and_q_lets_go(held: Rig) -> None:
    ours, theirs = os.openpty()
    try:
        process = subprocess.Popen(
            [sys.executable, "-m", "companion", "arm", "jog", "--yes", *held.options()],
            cwd=held.sandbox.cwd,
            env={**held.sandbox.environment, "TERM": "xterm"},
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            start_new_session=True,
        )
        os.close(theirs)
        seen = read_until(ours, r"joint 2\s.* \d+\.\d deg")
        before_deg = shown_deg(seen)
        os.write(ours, b"2-")
        while shown_deg(seen) > before_deg - 1.0:
            seen += read_until(ours, r"joint 2\s.* \d+\.\d deg")
        os.write(ours, b"q")
        seen += read_until(ours, "the arm is limp")
        assert process.wait(DEADLINE_S) == EXIT_OK, seen
    finally:
        os.close(ours)
    held.sandbox.assert_nobody_left()


def test_ctrl_c_leaves_the_arm_limp(held: Rig) -> None:
    with held.start("friction", "--yes") as running:
        running.wait_for("joint 1 to 90 deg, on the way")
        running.signal(signal.SIGINT)
        ended = running.end()
    assert ended.code == EXIT_ABORTED and ended.err_lines == ["companion arm: interrupted"], ended
    limp = scan(load_vehicle(held.vehicle, held.overrides()).arm_device, only=int(FILES))
    assert [servo.as_json()["torque_on"] for servo in limp.servos] == [False, False]
    assert [servo.as_json()["watchdog"] for servo in limp.servos] == ["off", "off"]
    held.sandbox.assert_nobody_left()


@pytest.mark.parametrize("background", [False, True], ids=["terminal", "background"])
def test_ctrl_c_during_zero_puts_the_lights_out(held: Rig, background: bool) -> None:
    with held.start("zero", background=background) as running:
        running.wait_for("1/3  hold the whole arm")
        running.signal(signal.SIGINT)
        ended = running.end()
    assert ended.code == EXIT_ABORTED, ended
    held.sandbox.assert_nobody_left()


def test_jog_stops_when_gravity_does_not_explain_the_load(held: Rig) -> None:
    """The world's arm is far lighter than the vehicle file's: as if somebody pulled it up.

    The last test: on a computer that is held up, a joint ends beyond its limit before it is stopped, and the next tool refuses the arm.
    """
    heavy = ("--set", "vehicle.tool.net_mass_kg=0.5")
    code, done = held.json("jog", "--joint", "2", "--to", "125", "--yes", *heavy)
    assert code == EXIT_REFUSED
    # Three limits are passed within a few milliseconds; which of them the next read sees first is the computer's.
    reasons = ("beyond gravity; check for an obstacle", "from its reference", "runs away; unless it was pulled")
    assert any(reason in done["stopped"] for reason in reasons), done["stopped"]


def read_until(terminal: int, pattern: str) -> str:
    """What the terminal shows, until it shows this."""
    deadline_s, seen = time.monotonic() + DEADLINE_S, ""
    while not re.search(pattern, seen):
        left_s = deadline_s - time.monotonic()
        assert left_s > 0 and select.select([terminal], [], [], left_s)[0], (pattern, seen)
        try:
            seen += os.read(terminal, 65536).decode(errors="replace")
        except OSError:  # the process has ended
            raise AssertionError((pattern, seen)) from None
    return seen


def shown_deg(seen: str) -> float:
    """Where joint 2 is, by the newest line about it."""
    return float(re.findall(r"joint 2\s.* (\d+\.\d) deg", seen)[-1])
