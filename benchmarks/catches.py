"""Counts false and undetected catches by payload, in laboratories that no search has used.

python -m benchmarks.catches --laboratories 1000

Each laboratory is flown once, with the payloads in turn, until 2.5 s after the expected catch. A catch is reported if the companion's
event is dated within 0.1 s of the true first contact. Every other event is a false catch, and a true catch without its event, or whose
payload is then reported to have left the net, an undetected one.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Mapping, Sequence

from benchmarks.report import publish
from companion.config.document import ConfigError
from companion.config.shipped import DEFAULT_MISSION
from companion.model.types import Event
from companion.sitl_config.loader import load_sitl
from sitl.campaigns.flights import fly_to_end, with_world
from tools.docs.tables import markdown

PAYLOADS_KG = (0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.8)
UNTIL_S = 9.0
"""Mission time at which a flight ends; the catch is expected at 6.5 s."""
DATED_S = 0.1


def counts_of(events: Sequence[Event], caught_t_s: float | None) -> Counter[str]:
    """Return what to count of one flight.

    Args:
        events: the companion's events.
        caught_t_s: time of the true catch, flight clock; None if the payload was not caught.
    """
    caught = caught_t_s is not None
    dated = [
        caught_t_s is not None and abs(event.t_s - caught_t_s) <= DATED_S for event in events if event.id == "catch"
    ]
    kept = any(dated) and all(event.id != "payload_left" for event in events)
    return Counter(laboratories=1, caught=int(caught), false=int(not all(dated)), undetected=int(caught and not kept))


def table(counted: Mapping[float, Counter[str]]) -> str:
    """Return the counts by payload in kg as a Markdown table."""
    heads = ("laboratories", "caught", "false", "undetected")
    rows = [
        (f"{payload_kg:g} kg", *(str(count[head]) for head in heads)) for payload_kg, count in sorted(counted.items())
    ]
    return markdown(("payload", *heads), rows) + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Return 0, or 2 on bad input."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.catches")
    parser.add_argument("--laboratories", type=int, default=200, help="number of flights (%(default)s)")
    parser.add_argument("--first-seed", type=int, default=10_001, help="first laboratory (%(default)s)")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE")
    a = parser.parse_args(arguments)
    try:
        config = load_sitl(DEFAULT_MISSION, overrides=a.set, world="lab")
    except ConfigError as error:
        print(f"catches: {error}", file=sys.stderr)
        return 2
    counted: dict[float, Counter[str]] = {}
    for number in range(a.laboratories):
        payload_kg, seed = PAYLOADS_KG[number % len(PAYLOADS_KG)], a.first_seed + number
        flown = fly_to_end(with_world(config, {"payload_kg": payload_kg, "seed": seed}), until_mission_s=UNTIL_S)
        count = counts_of([event for output in flown.result.outputs for event in output.events], flown.caught_t_s)
        if flown.error or count["false"] or count["undetected"]:
            print(f"laboratory {seed}, {payload_kg:g} kg: {flown.error or dict(count)}", file=sys.stderr, flush=True)
        counted.setdefault(payload_kg, Counter()).update(count)
    changes = f" --set {' '.join(a.set)}" if a.set else ""
    publish(table(counted), f"catches --laboratories {a.laboratories} --first-seed {a.first_seed}{changes}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
