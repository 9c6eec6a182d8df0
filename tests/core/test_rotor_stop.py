"""Who may stop the rotors: whatever the inputs say, no DISARM or FORCE_DISARM leaves unless the vehicle stands, or is flipped."""

from __future__ import annotations

import dataclasses
from typing import Any

import msgspec
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from companion.core.flight_core import FlightCore
from companion.flight.heartbeat import Heartbeats
from companion.model.outputs import Outputs
from companion.model.types import AutopilotRequest, FlightMode, LandedState, LinkIdentity, OperatorCommand, Outcome
from tests.core.walk import ON_ITS_BACK, ON_ITS_ROTORS, STEP_S, STOPS, UPRIGHT, Account, Machine, begun, walked

PHASES = ("wait", "arm", "spool up", "hold", "land", "touchdown", "disarm")
"""Where the made-up inputs begin."""


def machine_from(phase: str, ticks: int | None = None, **changes: Any) -> tuple[FlightCore, Machine, Account]:
    # What stands still is watched from its first tick on.
    start = begun(phase, ticks if ticks is not None else 0 if phase in ("arm", "disarm") else 20)
    core, i = start.fork()
    return core, dataclasses.replace(Machine(i=i, floor_m=start.standing_m), **changes), Account(start.standing_m)


def requests(outputs: list[Outputs]) -> set[AutopilotRequest]:
    return {o.request for o in outputs}


def ids(outputs: list[Outputs]) -> list[str]:
    return [event.id for o in outputs for event in o.events]


def test_a_device_that_falls_silent_in_the_air_is_reported() -> None:
    """Only on the ground a device that has sent nothing is waited for without an event."""
    core, machine, _ = machine_from("hold")
    silent = [core.step(msgspec.structs.replace(machine.tick(), arm=None)) for _ in range(20)]
    assert "arm_lost" in ids(silent)


segments = st.lists(
    st.fixed_dictionaries(
        {
            "ticks": st.sampled_from((5, 20, 60, 220)),
            "mode": st.sampled_from(
                [*FlightMode, *[FlightMode.OFFBOARD] * 8, *[FlightMode.LAND] * 4]  # most of a flight is ours
            ),
            "landed": st.sampled_from((LandedState.ON_GROUND, LandedState.IN_AIR)),
            "armed": st.sampled_from((True, True, True, True, False)),
            "up_m_s": st.sampled_from((0.0, 0.0, 0.0, -1.0, -0.1, 0.05, 0.4, 1.0)),
            "aside_m_s": st.sampled_from((0.0, 0.0, 0.0, 0.02, 0.5)),
            "attitude": st.sampled_from((UPRIGHT, UPRIGHT, UPRIGHT, UPRIGHT, ON_ITS_BACK, ON_ITS_ROTORS)),
            "mocap_attitude": st.sampled_from((None, None, None, UPRIGHT)),
            "seen": st.sampled_from((True, True, True, False)),
            "feels_m_s2": st.sampled_from((9.81, 9.81, -9.81)),
            "system_status": st.sampled_from((4, 4, 5)),
        }
    ),
    min_size=1,
    max_size=6,
)


@pytest.mark.parametrize("phase", PHASES)
@settings(max_examples=15, deadline=None, derandomize=True, phases=[Phase.explicit, Phase.generate])
@given(segments)
def test_no_walk_of_inputs_makes_the_core_stop_rotors_that_may_not_be_stopped(
    phase: str, walk: list[dict[str, Any]]
) -> None:
    core, machine, account = machine_from(phase)
    for segment in walk:
        ticks = segment["ticks"]
        machine = dataclasses.replace(machine, **{key: value for key, value in segment.items() if key != "ticks"})
        walked(core, machine, ticks, account)


# -- it stands, or somebody flies ------------------------------------------------------------------------------------


def test_deaf_to_its_standing_px4_is_disarmed_after_four_seconds_of_rest() -> None:
    core, machine, account = machine_from("disarm")
    outputs = walked(core, machine, 220, account)
    assert AutopilotRequest.FORCE_DISARM in requests(outputs)


@pytest.mark.parametrize("mode", [FlightMode.MANUAL, FlightMode.HOLD])
@pytest.mark.parametrize("up_m_s", [0.0, 0.3])
def test_a_pilot_who_takes_over_after_touch_down_is_never_disarmed(mode: FlightMode, up_m_s: float) -> None:
    """PX4's detector does not see that it stood, the pilot climbs: FORCE_DISARM left 4 to 8 s after touch-down, in the air."""
    core, machine, _ = machine_from("disarm", 100)
    machine.mode, machine.up_m_s = mode, up_m_s
    outputs = walked(core, machine, 600)
    assert requests(outputs) == {AutopilotRequest.NONE}
    assert all(o.attitude is None for o in outputs)
    assert ids(outputs).count("pilot_took_over") == 1
    machine.armed = False
    assert walked(core, machine, 30)[-1].outcome is Outcome.ABORTED


def test_what_climbs_in_offboard_after_a_false_touch_down_is_never_disarmed() -> None:
    core, machine, account = machine_from("disarm")
    machine.up_m_s, machine.landed = 0.15, LandedState.ON_GROUND
    outputs = walked(core, machine, 350, account)
    assert not requests(outputs) & set(STOPS)


def test_px4_that_leaves_offboard_before_it_is_disarmed_lands() -> None:
    core, machine, _ = machine_from("disarm")
    machine.mode = FlightMode.OTHER
    outputs = walked(core, machine, 100)
    assert requests(outputs) == {AutopilotRequest.NONE, AutopilotRequest.LAND}


@pytest.mark.parametrize("mode", [FlightMode.MANUAL, FlightMode.HOLD])
def test_a_pilot_who_takes_over_between_arming_and_take_off_is_not_disarmed(mode: FlightMode) -> None:
    core, machine, _ = machine_from("arm", 1, landed=LandedState.ON_GROUND)
    machine.mode = mode
    outputs = walked(core, machine, 600)
    assert not requests(outputs) & set(STOPS)
    assert outputs[-1].outcome is None, "it waits for the pilot's own disarm"


@pytest.mark.parametrize("phase", ["spool up", "hold", "land", "touchdown", "disarm"])
def test_after_a_kill_nothing_is_sent_again_even_if_the_switch_is_released(phase: str) -> None:
    """Setpoints went on at full thrust, and the vehicle jumped when the switch was released."""
    core, machine, _ = machine_from(phase, system_status=8)
    outputs = walked(core, machine, 20)
    machine.system_status = 4
    outputs += walked(core, machine, 200)
    assert all(o.attitude is None for o in outputs)
    assert requests(outputs) == {AutopilotRequest.NONE}
    assert ids(outputs).count("killed") == 1 and "pilot_took_over" not in ids(outputs)
    assert outputs[-1].outcome is None, "PX4 disarms"
    machine.armed = False
    assert walked(core, machine, 40)[-1].outcome is (Outcome.CRASHED if phase in ("hold", "land") else Outcome.ABORTED)


def test_a_kill_during_px4s_landing_ends_the_requests_to_land() -> None:
    core, machine, _ = machine_from("hold")
    machine.mode = FlightMode.OTHER
    assert AutopilotRequest.LAND in requests(walked(core, machine, 20))
    machine.system_status = 8
    killed = walked(core, machine, 20)
    machine.system_status = 4
    assert requests([*killed, *walked(core, machine, 100)]) == {AutopilotRequest.NONE}


@pytest.mark.parametrize("phase", ["wait", "arm"])
def test_with_the_kill_switch_engaged_it_does_not_take_off(phase: str) -> None:
    core, machine, _ = machine_from(phase, 1, armed=False, landed=LandedState.ON_GROUND, system_status=8)
    outputs = walked(core, machine, 120)
    assert outputs[-1].outcome is Outcome.REFUSED
    assert "killed" in ids(outputs)


def test_landed_just_after_arming_it_ends_only_once_px4_shows_that_it_is_not_armed() -> None:
    """PX4's HEARTBEAT comes once a second: LAND 20 ms after ARM meets a status from before the arming."""
    core, machine, _ = machine_from("arm", 1, landed=LandedState.ON_GROUND, armed=False)
    begun = [
        core.step(msgspec.structs.replace(machine.tick(), command=OperatorCommand.LAND)),
        *walked(core, machine, 40),
    ]
    assert all(o.outcome is None for o in begun), "over while the rotors spool up"
    machine.armed = True
    outputs = walked(core, machine, 100)
    assert AutopilotRequest.DISARM in requests(outputs)
    assert outputs[-1].outcome is None
    machine.armed = False
    assert walked(core, machine, 100)[-1].outcome is Outcome.ABORTED


# -- it is flipped ---------------------------------------------------------------------------------------------------


def flipped(**changes: Any) -> tuple[FlightCore, Machine, Account]:
    core, machine, account = machine_from("hold", attitude=ON_ITS_BACK, up_m_s=-0.5, feels_m_s2=-9.81)
    for name, value in changes.items():
        setattr(machine, name, value)
    return core, machine, account


def first_s(outputs: list[Outputs], request: AutopilotRequest) -> float:
    return next(k for k, o in enumerate(outputs) if o.request is request) * STEP_S


def test_flipped_it_is_landed_first_and_disarmed_by_force_once_that_is_certain() -> None:
    core, machine, account = flipped()
    outputs = walked(core, machine, 20, account)
    machine.mode = FlightMode.LAND
    outputs += walked(core, machine, 30, account)
    assert [id_ for id_ in ids(outputs) if id_ in ("tilt", "crashed")] == ["tilt", "crashed"]
    assert first_s(outputs, AutopilotRequest.LAND) < 0.15
    assert 0.28 < first_s(outputs, AutopilotRequest.FORCE_DISARM) < 0.36
    assert AutopilotRequest.DISARM not in requests(outputs), "PX4 refuses that"
    machine.armed = False
    assert walked(core, machine, 40)[-1].outcome is Outcome.CRASHED


def test_flipped_and_refused_the_forced_disarm_is_requested_for_as_long_as_it_takes() -> None:
    core, machine, _ = flipped(mode=FlightMode.LAND)
    outputs = walked(core, machine, 1000)[20:]
    assert requests(outputs) == {AutopilotRequest.FORCE_DISARM}
    assert outputs[-1].outcome is None, "while PX4 is armed the flight is not over"


@pytest.mark.parametrize("flipped_s", [0.2, 0.28])
def test_it_rights_itself_in_time_and_is_landed(flipped_s: float) -> None:
    core, machine, _ = flipped()
    outputs = walked(core, machine, round(flipped_s / STEP_S))
    machine.attitude, machine.feels_m_s2, machine.mode = UPRIGHT, 9.81, FlightMode.LAND
    outputs += walked(core, machine, 60)
    assert not requests(outputs) & set(STOPS)
    assert AutopilotRequest.LAND in requests(outputs)
    assert "crashed" not in ids(outputs)


def test_it_rights_itself_late_while_the_forced_disarm_is_refused_and_is_landed() -> None:
    core, machine, _ = flipped(up_m_s=0.0)
    walked(core, machine, 40)
    machine.attitude, machine.feels_m_s2, machine.mode = UPRIGHT, 9.81, FlightMode.LAND
    assert requests(walked(core, machine, 60)) == {AutopilotRequest.LAND}


def test_flipped_under_a_pilot_nothing_is_sent() -> None:
    core, machine, _ = flipped(attitude=UPRIGHT, mode=FlightMode.MANUAL, feels_m_s2=9.81, up_m_s=0.0)
    walked(core, machine, 10)
    machine.attitude, machine.feels_m_s2 = ON_ITS_BACK, -9.81
    assert requests(walked(core, machine, 60)) == {AutopilotRequest.NONE}


# -- it is tipped over -----------------------------------------------------------------------------------------------


ON_THE_FLOOR_M = 0.15
"""Above standing height: the body's origin of a vehicle that lies on a rotor."""


def tipped(phase: str, height_m: float = ON_THE_FLOOR_M, **changes: Any) -> tuple[FlightCore, Machine, Account]:
    core, machine, account = machine_from(phase, attitude=ON_ITS_ROTORS, feels_m_s2=5.6)
    machine.position = (*machine.position[:2], machine.floor_m + height_m)
    for name, value in changes.items():
        setattr(machine, name, value)
    return core, machine, account


@pytest.mark.parametrize("phase", ["spool up", "land", "touchdown", "disarm"])
def test_tipped_over_on_the_floor_it_is_disarmed_by_force_for_as_long_as_it_takes(phase: str) -> None:
    """It drove its rotors into the floor for 30 s, and then for as long again under the guardian."""
    core, machine, account = tipped(phase)
    outputs = walked(core, machine, 20, account)
    if phase != "disarm":
        machine.mode = FlightMode.LAND
    outputs += walked(core, machine, 600, account)
    assert 0.48 < first_s(outputs, AutopilotRequest.FORCE_DISARM) < 0.68
    assert requests(outputs[40:]) == {AutopilotRequest.FORCE_DISARM}
    assert ids(outputs).count("crashed") == 1
    machine.armed = False
    assert walked(core, machine, 40)[-1].outcome is Outcome.CRASHED


@pytest.mark.parametrize("phase", ["touchdown", "disarm"])
def test_flipped_after_touch_down_it_is_disarmed_by_force(phase: str) -> None:
    core, machine, account = machine_from(phase, attitude=ON_ITS_BACK, feels_m_s2=-9.81)
    outputs = walked(core, machine, 30, account)
    assert 0.28 < first_s(outputs, AutopilotRequest.FORCE_DISARM) < 0.36
    machine.armed = False
    assert walked(core, machine, 40)[-1].outcome is Outcome.CRASHED


# -- whose mode it is ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", [FlightMode.HOLD, FlightMode.RETURN, FlightMode.TAKEOFF])
@pytest.mark.parametrize(("system_status", "pilot"), [(4, True), (5, False), (6, False), (None, True)])
def test_a_mode_that_px4s_failsafe_chose_is_no_pilots_and_is_landed(
    mode: FlightMode, system_status: int | None, pilot: bool
) -> None:
    core, machine, _ = machine_from("hold")
    machine.mode, machine.system_status = mode, system_status  # type: ignore[assignment]
    outputs = walked(core, machine, 30)
    assert ("pilot_took_over" if pilot else "offboard_left") in ids(outputs)
    assert requests(outputs) == {AutopilotRequest.NONE if pilot else AutopilotRequest.LAND}


def test_in_manual_a_pilot_flies_whatever_failsafe_acts() -> None:
    core, machine, _ = machine_from("hold")
    machine.mode, machine.system_status = FlightMode.MANUAL, 5
    outputs = walked(core, machine, 30)
    assert requests(outputs) == {AutopilotRequest.NONE}
    assert "pilot_took_over" in ids(outputs)


@pytest.mark.parametrize("mode", [FlightMode.MANUAL, FlightMode.HOLD])
@pytest.mark.parametrize("phase", [*PHASES, "autopilot land", "armed_externally"])
def test_in_every_stage_a_pilot_who_takes_over_is_in_the_heartbeat_to_the_guardian(
    phase: str, mode: FlightMode
) -> None:
    heartbeats = Heartbeats(LinkIdentity(autopilot_system=1, own_system=1, own_component=195, local_port=0), 0.0)

    def pilot_in(ticks: int) -> bool:
        for _ in range(ticks):
            i = machine.tick()
            beat = heartbeats.of(i, core.step(i))
        return beat.pilot

    if phase == "armed_externally":
        core, machine, _ = machine_from("wait", armed=True)
        machine.position = (*machine.position[:2], 1.0)
    elif phase == "autopilot land":
        core, machine, _ = machine_from("hold", seen=False)
        assert not pilot_in(20)
        machine.mode = FlightMode.LAND
        assert not pilot_in(10)
    else:
        core, machine, _ = machine_from(phase)
    machine.mode = mode
    assert pilot_in(10)
