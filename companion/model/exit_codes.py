"""Exit codes of `companion`, which users' scripts rely on."""

from __future__ import annotations

from companion.model.types import Outcome

EXIT_OK = 0
EXIT_BAD_INPUT = 2
"""The command line or a file is invalid; nothing was started and nothing moved."""
EXIT_REFUSED = 3
"""A device or the preflight check refused the flight; nothing was armed."""
EXIT_ABORTED = 4
"""The mission was aborted and the vehicle landed safely."""
EXIT_LOST = 5
EXIT_INTERNAL = 70
"""Exit code of the flight process, never of `companion`, after an internal error in the air; the guardian lands the vehicle."""

EXIT_CODES = {
    Outcome.COMPLETED: EXIT_OK,
    Outcome.REFUSED: EXIT_REFUSED,
    Outcome.ABORTED: EXIT_ABORTED,
    Outcome.CRASHED: EXIT_LOST,
    Outcome.LOST: EXIT_LOST,
}
