"""The end of a command at Ctrl-C."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Sequence

from companion.model.exit_codes import EXIT_ABORTED


def interrupted(words: Sequence[str]) -> int:
    """Report that Ctrl-C has ended the command with this command line, and return the exit code."""
    with contextlib.suppress(OSError):
        print(f"{' '.join(['companion', *words[:1]])}: interrupted", file=sys.stderr)
    return EXIT_ABORTED
