"""`python -m sitl.campaigns`: reads a job from standard input and flies it."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from contextlib import closing

from companion.campaigns.process import CampaignError
from companion.sitl_config.loader import SitlConfig
from sitl.campaigns import compare, faults, robustness
from sitl.campaigns.runner import Data, fly_all

_CAMPAIGNS = {
    "compare": (compare.prepare, compare.fly),
    "robustness": (robustness.prepare, robustness.fly),
    "faults": (faults.prepare, faults.fly),
}


def main() -> int:
    """Read a job from standard input and fly it; return the exit code."""
    job = json.loads(sys.stdin.buffer.readline())
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()
    prepare, fly = _CAMPAIGNS[job["campaign"]]
    try:
        configs = [SitlConfig.model_validate_json(json.dumps(config)) for config in job["configs"]]
        flights = prepare(job, configs)
        with closing(fly_all(fly, configs, flights, job["jobs"], job["scheduler"])) as results:
            for result in results:
                _send({"type": "flight", **result})
    except CampaignError as error:
        _send({"type": "error", "text": str(error), "bad_input": error.bad_input})
        return 1
    return 0


def _send(message: Data) -> None:
    sys.stdout.write(json.dumps(message, allow_nan=False) + "\n")
    sys.stdout.flush()


def _end_with_parent() -> None:
    """End this process and its workers when standard input closes."""
    while os.read(sys.stdin.fileno(), 4096):
        pass
    if os.getpgrp() == os.getpid():
        os.killpg(0, signal.SIGTERM)
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main())
