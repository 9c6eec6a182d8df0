"""`python -m sitl.campaigns`: reads a job from standard input and flies it."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from contextlib import closing
from queue import SimpleQueue

from companion.campaigns.process import CampaignError
from companion.sitl_config.loader import SitlConfig
from sitl.campaigns import compare, faults, pair, robustness, tune
from sitl.campaigns.runner import Data, fly_all

_CAMPAIGNS = {
    "compare": (compare.prepare, compare.fly),
    "pair": (pair.prepare, pair.fly),
    "robustness": (robustness.prepare, robustness.fly),
    "faults": (faults.prepare, faults.fly),
    "tune": (tune.prepare, tune.fly),
}


def main() -> int:
    """Read a job from standard input and fly it; return the exit code."""
    lines: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=_read_until_parent_ends, args=(lines,), name="parent", daemon=True).start()
    job = json.loads(lines.get())
    prepare, fly = _CAMPAIGNS[job["campaign"]]
    try:
        configs = [SitlConfig.model_validate_json(json.dumps(config)) for config in job["configs"]]
        batch = job.get("batches", False)
        while True:
            if batch:
                job |= json.loads(lines.get())
            flights = prepare(job, configs)
            with closing(fly_all(fly, configs, flights, job["jobs"], job["scheduler"], batch=batch)) as results:
                for result in results:
                    _send({"type": "flight", **result})
            if not batch:
                return 0
    except CampaignError as error:
        _send({"type": "error", "text": str(error), "bad_input": error.bad_input})
        return 1


def _send(message: Data) -> None:
    sys.stdout.write(json.dumps(message, allow_nan=False) + "\n")
    sys.stdout.flush()


def _read_until_parent_ends(lines: SimpleQueue[bytes]) -> None:
    unfinished = b""
    while data := os.read(sys.stdin.fileno(), 1 << 16):
        *whole, unfinished = (unfinished + data).split(b"\n")
        for line in whole:
            lines.put(line)
    if os.getpgrp() == os.getpid():
        os.killpg(0, signal.SIGTERM)
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main())
