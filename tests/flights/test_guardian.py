"""A guardian that is missing refuses the flight, over real wires.

A flight process that it lands, with the interpreter held: test_lockstep.py; after an error: tests/launcher/test_team.py. A guardian
that dies in the air: test_shared_flight.py.
"""

from __future__ import annotations

from pathlib import Path

from companion.model.exit_codes import EXIT_REFUSED
from tests.support import HOVER, hooked, read_summary, sandbox_in


def test_without_a_guardian_nothing_takes_off(tmp_path: Path) -> None:
    """It cannot even start: what it needs is broken."""
    broken = tmp_path / "packages"
    broken.mkdir()
    hook = "import sys\nif 'companion.guardian' in sys.orig_argv:\n    raise SystemExit('a broken guardian')\n"
    (broken / "sitecustomize.py").write_text(hook, encoding="utf-8")
    with sandbox_in(tmp_path / "sandbox", hooked(broken)) as sandbox:
        ended = sandbox.run("fly", HOVER, "--sitl", "--out", "out")
        sandbox.assert_nobody_left()
        summary = read_summary(sandbox.cwd / "out")
    assert ended.code == EXIT_REFUSED, ended.err
    assert "guardian: its process ended before it was ready" in ended.err
    assert summary["outcome"] == "refused"
