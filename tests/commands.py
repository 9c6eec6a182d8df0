"""Commands that run in this process, with the exit code that a test expects."""

from __future__ import annotations

from companion.model.exit_codes import EXIT_OK
from tests.support import Ended, run_here


def companion(*words: object, code: int = EXIT_OK) -> Ended:
    """Run `companion WORDS` to its end."""
    ended = run_here(*words)
    assert ended.code == code and "Traceback" not in ended.err, ended
    return ended


def refused(code: int, *words: object) -> str:
    """Run a command that ends with this exit code; return its one line on standard error."""
    (line,) = companion(*words, code=code).err_lines
    return line
