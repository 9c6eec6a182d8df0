"""Start-up of every process at the other end of a wire."""

from __future__ import annotations

import signal

from companion.runtime.realtime import WORLD_PRIORITY, claim_realtime


def prepare_far_end() -> None:
    """Ignore Ctrl-C, which the parent handles, and claim the priority of the simulated world."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    claim_realtime(WORLD_PRIORITY)
