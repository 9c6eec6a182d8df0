"""Exit codes of `companion`, a contract with outside scripts."""

from __future__ import annotations

from companion.model.types import Outcome

EXIT_OK = 0
EXIT_BAD_INPUT = 2
"""The command line or a file is wrong; nothing was started, nothing moved."""
EXIT_REFUSED = 3
"""A device or the preflight refused; nothing was armed."""
EXIT_ABORTED = 4
"""The mission was given up and the machine landed safely."""
EXIT_LOST = 5
"""Crashed or lost."""
EXIT_INTERNAL = 70
"""Of the flight process alone, never of `companion`: an error of its own in the air; the guardian lands."""

EXIT_CODES = {
    Outcome.COMPLETED: EXIT_OK,
    Outcome.REFUSED: EXIT_REFUSED,
    Outcome.ABORTED: EXIT_ABORTED,
    Outcome.CRASHED: EXIT_LOST,
    Outcome.LOST: EXIT_LOST,
}
