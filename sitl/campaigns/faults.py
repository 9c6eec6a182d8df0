"""Flies the flights of `companion faults`.

A flight is {kind, size, duration_s, phase}: the fields of `companion.campaigns.faults.variants.Variant` and the phase of flight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from companion.campaigns.faults.judge import FaultFlight, Point, row_of, ticks_of
from companion.campaigns.faults.variants import Variant
from companion.campaigns.process import CampaignError
from companion.model.frames import tilt_rad
from companion.model.types import Outcome
from companion.safety.tether import slack_m as slack_of
from companion.safety.touchdown import HEIGHT_MARGIN_M
from companion.sitl_config.loader import SitlConfig
from sitl.campaigns.flights import Flown, fly_to_end, laboratory_of, outcome_of, with_world
from sitl.campaigns.runner import Data
from sitl.faults.timing import FaultError, with_fault_times
from sitl.world.state import Snapshot


def prepare(job: Data, configs: Sequence[SitlConfig]) -> list[Data]:
    """Return the flights of the job.

    Raises:
        CampaignError: the mission lacks one of the phases.
    """
    (config,) = configs
    flights: list[Data] = job["flights"]
    for phase in {flight["phase"] for flight in flights}:
        try:
            with_fault_times(with_world(config, {"faults": [{"kind": "mocap_loss", "phase": phase}]}))
        except FaultError as error:
            raise CampaignError(str(error), bad_input=True) from None
    return flights


def fly(config: SitlConfig, flight: Data) -> Data:
    """Fly one flight; return its row (see `companion.campaigns.faults.judge`)."""
    variant, phase = Variant(flight["kind"], flight["size"], flight["duration_s"]), flight["phase"]
    flown = fly_to_end(with_world(config, {"faults": [variant.fault(phase)]}))
    return {"row": {**row_of(variant, phase, record_of(flown), config.vehicle), **laboratory_of(flown.config)}}


def record_of(flown: Flown) -> FaultFlight:
    """Return the record of a flight in the form that `companion.campaigns.faults.judge` grades."""
    fast, result = flown.fast, flown.result
    if fast is None:
        return FaultFlight(
            outcome=Outcome.LOST.value,
            begun_s=None,
            course=(),
            ticks=(),
            events=(),
            landed=False,
            caught=False,
            error=flown.error,
        )
    tether, layout, touches = fast.config.vehicle.tether, result.layout, bool(fast.config.world.surfaces)
    assert layout is not None

    def point(snapshot: Snapshot) -> Point:
        x, y, z, w, i, j, k = snapshot.q[0:7]
        attitude = (w, i, j, k)
        slack_m = slack_of(tether, (x, y, z), attitude) if tether is not None else None
        return Point(
            t_s=snapshot.t_s,
            position_world_m=(x, y, z),
            tilt_rad=tilt_rad(attitude),
            slack_m=slack_m,
            tension_n=abs(layout.tension_n(snapshot.sensors)),
            contact_n=math.hypot(*layout.contact(snapshot.sensors)[1]) if touches else 0.0,
        )

    # A flight process that stalls leaves snapshots between its ticks.
    course = sorted((point(s) for s in (*result.snapshots, *result.after)), key=lambda at: at.t_s)
    events = sorted(
        [*(event for o in result.outputs for event in o.events), *result.guardian_events], key=lambda event: event.t_s
    )
    low_m = fast.config.vehicle.airframe.ground_clearance_m + HEIGHT_MARGIN_M
    landed = bool(course) and course[-1].position_world_m[2] < low_m and not result.armed
    return FaultFlight(
        outcome=outcome_of(result).value,
        begun_s=fast.faults.begun_s,
        course=course,
        ticks=ticks_of(result.outputs),
        events=events,
        landed=landed,
        caught=result.caught,
    )
