"""Without motion capture PX4's position drifts while PX4 lands: no rule about the vehicle's place is judged by it."""

from __future__ import annotations

import msgspec
import pytest

from companion.config.loader import load_vehicle
from companion.safety.monitors import Monitors
from tests.safety.healthy import SLOW, flying, healthy, put, stopped, watched

VEHICLE = load_vehicle("configs/vehicles/tarot650_2r.yaml")
TAUT = msgspec.structs.replace(SLOW, taut=True)
LOST = stopped("mocap")


@pytest.mark.parametrize("mocap", [True, False])
def test_a_place_is_judged_only_while_poses_arrive(mocap: bool) -> None:
    monitors = Monitors(VEHICLE)
    sound = [healthy(k) for k in range(20)]
    lost = [healthy(k) if mocap else LOST(healthy(k)) for k in range(20, 300)]
    elsewhere = put("vehicle", position_world_m=(3.0, 0.0, 1.0))
    drifted = [elsewhere(healthy(k) if mocap else LOST(healthy(k))) for k in range(300, 600)]
    events = watched(VEHICLE, sound + lost, flying(), monitors)
    assert [event.id for event in events] == ([] if mocap else ["mocap_lost"])
    found = {event.id for event in watched(VEHICLE, drifted, flying(tether=TAUT), monitors)}
    assert ({"geofence_left", "tether_taut"} <= found) == mocap
    assert mocap or not found
