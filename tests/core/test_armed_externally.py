"""The companion starts while PX4 is armed already: it lands what flies, disarms what stands, leaves people alone, and lifts nothing."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from companion.core.flight_core import FlightCore
from companion.model.flight_stage import PILOT_MODES
from companion.model.outputs import Outputs
from companion.model.types import (
    AutopilotRequest,
    FlightMode,
    Inputs,
    LandedState,
    MocapPose,
    OperatorCommand,
    Outcome,
    SafetyAction,
    Severity,
    VehicleState,
)
from companion.safety.rotor_stop import DISARM_STILL_S
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from tests.flights.ends import Changed
from tests.safety.healthy import healthy, put
from tests.support import CATCH, SHORT_CATCH

pytestmark = pytest.mark.usefixtures("short_start")

replace = msgspec.structs.replace
Change = Callable[[Inputs], Inputs]


CONFIG = FastFlight(load_sitl(CATCH)).config
HIGH, STANDING = (0.0, 0.0, 1.0), (0.0, 0.0, CONFIG.vehicle.airframe.ground_clearance_m)


def found(mode: FlightMode, landed: LandedState, height: tuple[float, float, float], tick: int) -> Inputs:
    """A tick with PX4 armed."""
    i = healthy(tick)
    for change in (
        put("status", mode=mode, landed=landed),
        put("mocap", position_world_m=(height[0] + i.mocap.position_world_m[0], 0.0, height[2])),  # type: ignore[union-attr]
        put("vehicle", position_world_m=(height[0] + i.mocap.position_world_m[0], 0.0, height[2])),  # type: ignore[union-attr]
    ):
        i = change(i)
    return i


def stepped(inputs: list[Inputs]) -> list[Outputs]:
    core = FlightCore(CONFIG)
    return [core.step(i) for i in inputs]


def ids(outputs: list[Outputs]) -> list[str]:
    return [event.id for o in outputs for event in o.events]


EVERY = list(itertools.product(FlightMode, LandedState, ("high", "standing")))


@pytest.mark.parametrize(("mode", "landed", "where"), EVERY)
def test_every_mode_landed_state_and_height(mode: FlightMode, landed: LandedState, where: str) -> None:
    height = HIGH if where == "high" else STANDING
    outputs = stepped([found(mode, landed, height, tick) for tick in range(100)])
    ours = mode in (FlightMode.OFFBOARD, FlightMode.LAND)
    stands = landed is LandedState.ON_GROUND and where == "standing" and ours
    assert ids(outputs).count("armed_externally") == 1
    event = next(event for event in outputs[0].events if event.id == "armed_externally")
    assert event.severity is Severity.CRITICAL
    assert f"{height[2]:.2f} m" in event.text and mode.value.upper() in event.text
    assert all(o.attitude is None for o in outputs), "no setpoint, with thrust or without"
    requests = {o.request for o in outputs}
    if mode in PILOT_MODES:
        assert requests == {AutopilotRequest.NONE}
        assert "a pilot has chosen" in event.text
    elif stands:
        assert requests == {AutopilotRequest.NONE, AutopilotRequest.DISARM}
        first = next(o for o in outputs if o.request is AutopilotRequest.DISARM)
        assert first.t_s - outputs[0].t_s >= DISARM_STILL_S, "it must have stood still"
        assert event.action is SafetyAction.LAND
    else:
        assert requests == {AutopilotRequest.LAND}
        assert event.action is SafetyAction.AUTOPILOT_LAND
    assert all(o.mocap_trusted for o in outputs)


@pytest.mark.parametrize("mode", [FlightMode.LAND, FlightMode.OFFBOARD])
@pytest.mark.parametrize("command", list(OperatorCommand))
@pytest.mark.parametrize("lost", ["", "arm", "force", "mocap", "vehicle"])
def test_whatever_else_is_wrong_it_lands(mode: FlightMode, command: OperatorCommand, lost: str) -> None:
    def tick(k: int) -> Inputs:
        i = replace(found(mode, LandedState.IN_AIR, HIGH, k), command=command, guardian_ready=False)
        return replace(i, **{lost: None}) if lost else i

    outputs = stepped([tick(k) for k in range(30)])
    assert {o.request for o in outputs} == {AutopilotRequest.LAND}
    assert all(o.attitude is None and o.outcome is None for o in outputs)
    assert "armed_externally" in ids(outputs[:1])


def test_armed_by_somebody_else_while_the_companion_waits_it_does_not_take_off() -> None:
    """On the ground, in the mode that the companion itself has asked for."""
    flight = FastFlight(load_sitl(CATCH))
    inputs = flight.run(limit_s=1.2).inputs
    core, outputs = FlightCore(flight.config), []
    for i in inputs:
        if i.t_s > 0.6:
            i = put("status", armed=True, mode=FlightMode.OFFBOARD)(i)
        outputs.append(core.step(i))
    assert outputs[-1].request is AutopilotRequest.DISARM
    assert ids(outputs) == ["armed_externally"]
    last = stepped_on(core, inputs[-1], armed=False)
    assert last.outcome is Outcome.REFUSED


def stepped_on(core: FlightCore, i: Inputs, *, armed: bool) -> Outputs:
    """Two ticks more."""
    for k in (1, 2):
        o = core.step(put("status", armed=armed)(replace(i, tick=i.tick + k, t_s=i.t_s + 0.005 * k)))
    return o


def test_one_that_stands_and_does_not_disarm_is_reported() -> None:
    outputs = stepped([found(FlightMode.OFFBOARD, LandedState.ON_GROUND, STANDING, tick) for tick in range(1700)])
    assert outputs[-1].outcome is Outcome.REFUSED
    assert "disarm_refused" in ids(outputs)


# -- flown -----------------------------------------------------------------------------------------------------------


class Dies:
    """A companion that dies and is started again; what PX4 does meanwhile is PX4's."""

    def __init__(self, config: SitlConfig, died_s: float, back_s: float) -> None:
        self._config, self._died_s, self._back_s = config, died_s, back_s
        self._core = FlightCore(config)
        self._reborn = self._dead = False
        self._last: Outputs | None = None

    def step(self, i: Inputs) -> Outputs:
        if i.t_s < self._died_s:
            self._last = self._core.step(i)
            return self._last
        assert self._last is not None
        self._dead = i.t_s < self._back_s
        if self._dead:
            return replace(
                self._last, tick=i.tick, t_s=i.t_s, attitude=None, arm_torque_nm=None, request=AutopilotRequest.NONE,
                events=(), mocap_trusted=False,
            )  # fmt: skip
        if not self._reborn:
            self._core, self._reborn = FlightCore(self._config), True
        return self._core.step(i)

    def forwards(self, pose: MocapPose, vehicle: VehicleState | None) -> bool:
        return not self._dead and self._core.forwards(pose, vehicle)


def flown(
    died_s: float, back_s: float, change: Change = lambda i: i, mission: Path = SHORT_CATCH
) -> tuple[FastFlight, FastResult]:
    # With a barometer PX4 would have found the floor by then.
    flight = Changed(load_sitl(mission, overrides=["world.px4_params={EKF2_BARO_CTRL: 0}"]), change)
    flight.core = Dies(flight.config, died_s, back_s)  # type: ignore[assignment]
    return flight, flight.run()


@pytest.mark.parametrize(
    ("mission", "died_s", "gone_s"), [(CATCH, 5.2, 8.0), (SHORT_CATCH, 5.8, 0.1), (SHORT_CATCH, 5.8, 2.5)]
)
def test_started_again_in_the_air_it_lands_what_still_flies(mission: Path, died_s: float, gone_s: float) -> None:
    """PX4 has been without motion capture and has no barometer: after 1.4 s it descends blindly and never finds that it stands."""
    flight, result = flown(died_s, died_s + gone_s, mission=mission)
    after = [o for o in result.outputs if o.t_s >= died_s + gone_s]
    assert ids(after)[0] == "armed_externally"
    assert result.outputs[-1].outcome is Outcome.ABORTED
    assert not result.crashed and not flight.px4.armed
    assert result.truth[-1].position_world_m[2] < STANDING[2] + 0.05
    assert AutopilotRequest.ARM not in {o.request for o in after}
    lifted = [o for o in after if o.attitude is not None and o.attitude.thrust > 0.0]
    assert not lifted
    if gone_s < 1.0:
        assert_folds_at_a_bounded_rate(result, died_s + gone_s)


def assert_folds_at_a_bounded_rate(result: FastResult, since_s: float) -> None:
    back = [truth.joint_angle_rad for truth in result.truth if truth.t_s >= since_s]
    fastest = max(
        abs(b - a) / 0.005
        for before, after in itertools.pairwise(back[20:])
        for a, b in zip(before, after, strict=True)
    )
    assert fastest < math.radians(250)
    folded = [math.degrees(angle) for angle in result.truth[-1].joint_angle_rad]
    assert max(abs(a - b) for a, b in zip(folded, (165.0, 140.0), strict=True)) < 15


def test_with_a_dead_arm_bus_it_lands_all_the_same() -> None:
    """The servos' currents end with the process that wrote them: the arm hangs."""
    flight, result = flown(5.8, 8.3, lambda i: replace(i, arm=None, force=None) if i.t_s >= 5.8 else i)
    assert result.outputs[-1].outcome is Outcome.ABORTED
    assert not result.crashed and not flight.px4.armed
    assert all(o.arm_torque_nm is None for o in result.outputs if o.t_s >= 5.8)
    assert max(abs(angle) for truth in result.truth for angle in truth.joint_angle_rad) < math.radians(180)


def test_a_pilot_who_flies_is_only_given_motion_capture() -> None:
    def change(i: Inputs) -> Inputs:
        return put("status", mode=FlightMode.MANUAL)(i) if i.t_s >= 5.8 else i

    _, result = flown(5.8, 6.0, change)
    after = [o for o in result.outputs if o.t_s >= 6.0]
    assert all(o.attitude is None and o.request is AutopilotRequest.NONE for o in after)
    assert ids(after).count("armed_externally") == 1
    assert after[-1].outcome is Outcome.ABORTED, "PX4 disarmed"


def test_a_vehicle_found_killed_is_only_given_motion_capture() -> None:
    """PX4 reports the kill for as long as the switch is engaged, and stays armed for COM_KILL_DISARM."""
    inputs = [found(FlightMode.OFFBOARD, LandedState.IN_AIR, HIGH, tick) for tick in range(100)]
    inputs = [put("status", system_status=8 if i.tick < 50 else 4)(i) for i in inputs]
    outputs = stepped(inputs)
    assert all(o.attitude is None and o.request is AutopilotRequest.NONE for o in outputs)
    assert {"killed", "armed_externally"} <= set(ids(outputs))
