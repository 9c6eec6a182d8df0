"""`python -m sitl.campaigns.faults`: one mission with one fault after the other, in the fast loop. Started by `companion faults`.

Standard input: one line of JSON, then nothing; when it ends, so does the campaign.
    config        effective configuration (`SitlConfig`)
    flights       {kind, size, duration_s, phase}, as of `companion.campaigns.faults.Variant`
    jobs          processes; null: one per core
    scheduler     address of a Dask scheduler instead; null: this machine
Standard output: JSON lines as from `sitl.campaigns.flights`; rows as `companion.campaigns.faults.row_of` makes them.
"""

from __future__ import annotations

import json
import math
import sys
import time

from companion.campaigns.faults import Flown, Point, Tick, Variant, row_of
from companion.model.frames import quat_rotate, tilt_rad
from companion.model.types import Outcome
from companion.safety.touchdown import HEIGHT_MARGIN_M
from companion.sitl_config.loader import SitlConfig
from sitl.campaigns import flights as campaign
from sitl.campaigns.flights import CampaignError, Data
from sitl.fast.loop import FastFlight, FastResult
from sitl.faults.timing import FaultError, in_time
from sitl.world.world import Snapshot


def fly(config_json: str, flight: Data) -> Data:
    """One flight: {row, wall_s}.

    Args:
        config_json: effective configuration.
        flight: as on standard input.
    """
    begun_s = time.perf_counter()
    variant = Variant(flight["kind"], flight["size"], flight["duration_s"])
    data = json.loads(config_json)
    data["world"]["faults"] = [variant.fault(flight["phase"])]
    config = SitlConfig.model_validate_json(json.dumps(data))
    fast, result, error = None, FastResult(), None
    try:
        fast = FastFlight(config)
        result = fast.run()
    # A law that cannot go on ends its flight process: that flight is lost, and the others are flown all the same.
    except Exception as failure:
        error = f"{type(failure).__name__}: {failure}"
    row = row_of(variant, flight["phase"], flown(fast, result, error), config.vehicle)
    return {"row": row, "wall_s": time.perf_counter() - begun_s}


def flown(fast: FastFlight | None, result: FastResult, error: str | None = None) -> Flown:
    """A fast flight as the table judges it."""
    if fast is None:
        return Flown(Outcome.LOST.value, None, (), (), (), False, False, error)
    tether, layout = fast.config.vehicle.tether, result.layout
    anchor, lever = tether.anchor_world_m, tether.attachment_body_m
    assert layout is not None

    def point(snapshot: Snapshot) -> Point:
        x, y, z, w, i, j, k = snapshot.q[0:7]
        attitude = (w, i, j, k)
        tied = [a + b for a, b in zip((x, y, z), quat_rotate(attitude, lever), strict=True)]
        slack_m = tether.length_m - math.dist(tied, anchor)
        return Point(snapshot.t_s, (x, y, z), tilt_rad(attitude), slack_m, abs(snapshot.sensors[layout.tether]))

    # A flight process that was held up for a moment leaves snapshots between its ticks.
    course = sorted((point(s) for s in (*result.snapshots, *result.after)), key=lambda at: at.t_s)
    ticks = [
        Tick(o.t_s, o.phase_kind, o.action, o.reference.position_world_m if o.reference is not None else None)
        for o in result.outputs
    ]
    events = sorted(
        [*(event for o in result.outputs for event in o.events), *result.guardian_events], key=lambda event: event.t_s
    )
    low_m = fast.config.vehicle.airframe.ground_clearance_m + HEIGHT_MARGIN_M
    stands = bool(course) and course[-1].position_world_m[2] < low_m and not result.armed
    return Flown(_outcome(result).value, fast.faults.begun_s, course, ticks, events, stands, result.caught, error)


def _outcome(result: FastResult) -> Outcome:
    if result.crashed:
        return Outcome.CRASHED
    if result.guardian_landed is not None:
        return Outcome.ABORTED if result.guardian_landed else Outcome.LOST
    ended = result.outputs[-1].outcome if result.outputs else None
    return ended or Outcome.LOST


def grid(job: Data) -> tuple[list[str], list[Data]]:
    """Configuration and flights of a job.

    Raises:
        CampaignError: the mission has no such phase.
    """
    config = SitlConfig.model_validate_json(json.dumps(job["config"]))
    flights = [{**flight, "variant": 0} for flight in job["flights"]]
    for phase in {flight["phase"] for flight in flights}:
        faults = [{"kind": "mocap_loss", "phase": phase}]
        data = {**job["config"], "world": {**job["config"]["world"], "faults": faults}}
        try:
            in_time(SitlConfig.model_validate_json(json.dumps(data)))
        except FaultError as error:
            raise CampaignError(str(error), bad_input=True) from None
    return [config.model_dump_json()], flights


def main() -> int:
    """Fly what standard input asks for."""
    return campaign.serve(grid, fly)


if __name__ == "__main__":
    # Workers find the functions by the module's name, which is not __main__ for them.
    from sitl.campaigns import faults as fault_campaign

    sys.exit(fault_campaign.main())
