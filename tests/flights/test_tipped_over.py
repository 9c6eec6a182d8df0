"""A vehicle that tips over, on the floor or in the air: its rotors are stopped. In the fast closed loop."""

from __future__ import annotations

import math

import pytest

from companion.model.frames import euler_zyx_from_quat, tilt_rad
from companion.model.types import AutopilotRequest, Outcome
from companion.sitl_config.loader import load_sitl
from sitl.fast.loop import FastFlight
from sitl.world.handling import Wrench
from sitl.world.machine import Machine
from tests.support import HOVER, LOW_HOVER

pytestmark = pytest.mark.usefixtures("short_start")

LIES_AT_RAD = math.radians(50.0)
"""Two feet 0.18 m beside the origin and 0.28 m below it, and the edge of a rotor disk 0.45 m beside it: atan(0.31 / 0.27) = 49 deg."""
STIFFNESS_NM, DAMPING_NMS = 80.0, 8.0
"""Of the floor under that rotor, which the world does not have; far stronger than the rotors."""
STOPPED_WITHIN_S = 1.5


class TippedOver(FastFlight):
    """A low hover that is tipped over, and lies, from the first moment of its landing at which it is below `below_m`."""

    def __init__(self, below_m: float, after_s: float, *faults: str) -> None:
        low = [f"{key}={value}" for key, value in LOW_HOVER.items()]
        super().__init__(load_sitl(HOVER, overrides=[*low, f"world.faults=[{', '.join(faults)}]"]))
        self.begun_s = self.stopped_s = math.inf
        scene, machine, act = self.plant.scene, self.plant.machine, self.plant.act

        def tipping(armed: bool) -> None:
            if armed and scene.t_s > after_s and machine.q[2] < below_m:
                self.begun_s = min(self.begun_s, scene.t_s)
            if scene.t_s >= self.begun_s:
                w, x, y, z = machine.q[3:7]
                torque_nm = (
                    STIFFNESS_NM * (LIES_AT_RAD - euler_zyx_from_quat((w, x, y, z))[0]) - DAMPING_NMS * machine.v[3]
                )
                machine.hold(Wrench(force_n=(0.0, 0.0, 0.0), torque_nm=(torque_nm, 0.0, 0.0)))
                if not armed:
                    self.stopped_s = min(self.stopped_s, scene.t_s)
            act(armed)

        self.plant.act = tipping  # type: ignore[method-assign]


@pytest.mark.parametrize(
    ("below_m", "after_s"), [(0.35, 6.7), (0.31, 8.2)], ids=["just before touch-down", "after touch-down"]
)
def test_tipped_over_on_the_floor_its_rotors_are_stopped_by_the_flight(below_m: float, after_s: float) -> None:
    flight = TippedOver(below_m, after_s)
    result = flight.run()
    assert not result.crashed, "the world's word for beyond 72 deg: that is another test"
    assert tilt_rad(result.truth[-1].attitude_wxyz) == pytest.approx(LIES_AT_RAD, abs=math.radians(12.0))
    assert flight.stopped_s - flight.begun_s < STOPPED_WITHIN_S
    assert result.outputs[-1].outcome is Outcome.CRASHED
    assert [event.id for outputs in result.outputs for event in outputs.events].count("crashed") == 1


def test_tipped_over_on_the_floor_its_rotors_are_stopped_by_the_guardian() -> None:
    flight = TippedOver(0.35, 6.7, "{kind: kill_flight, t_s: 4.4}")
    result = flight.run()
    assert result.guardian_landed is True
    assert "tipped over on the floor: FORCE_DISARM is requested at once" in [e.text for e in result.guardian_events]
    assert flight.stopped_s - flight.begun_s < STOPPED_WITHIN_S


def test_flipped_in_the_air_by_a_lost_rotor_the_others_are_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    """LAND comes first and does not help: PX4 refuses a plain DISARM in the air, and its rotors went on in the wreck."""
    monkeypatch.setattr(Machine, "watch_crash", lambda *_: None)  # the fast loop ends with the world's word
    # High enough to turn over before it is down.
    high = ("mission.phases[0].height_m=1.6", "mission.phases[0].duration_s=5.0")
    flight = FastFlight(load_sitl(HOVER, overrides=[*high, "world.faults=[{kind: motor_weak, size: 1.0, t_s: 7.0}]"]))
    result = flight.run()
    at_s = {event.id: outputs.t_s for outputs in result.outputs for event in outputs.events}
    assert at_s["tilt"] < at_s["crashed"]
    assert result.outputs[-1].outcome is Outcome.CRASHED
    stopped_s = next(
        i.t_s for i in result.inputs if i.t_s > at_s["crashed"] and i.status is not None and not i.status.armed
    )
    assert stopped_s - at_s["crashed"] < STOPPED_WITHIN_S
    assert AutopilotRequest.DISARM not in {outputs.request for outputs in result.outputs}
