"""What every process at the other end of a wire does first."""

from __future__ import annotations

import signal

from companion.runtime.realtime import WORLD_PRIORITY, claim_realtime


def stand_apart() -> None:
    """The other end of a wire: Ctrl-C is the business of the process that started it; priority as of the simulated world."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    claim_realtime(WORLD_PRIORITY)
