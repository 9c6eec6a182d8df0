"""A machine in good health, tick by tick: every value moves a little, as real ones do."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable

from companion.config.vehicle import Vehicle
from companion.model.frames import quat_from_euler_zyx
from companion.model.types import (
    ArmState,
    AutopilotStatus,
    ControlLog,
    Event,
    FlightMode,
    ForceSample,
    Inputs,
    LandedState,
    MocapPose,
    OperatorCommand,
    TetherState,
    Vec8,
    VehicleState,
)
from companion.safety.monitors import Monitors
from companion.safety.situation import Situation

TICK_S = 0.005
START_S = 10.0
ZERO3 = (0.0, 0.0, 0.0)
ZERO8: Vec8 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
SLOW = TetherState(1.8, 1.2, 1.2, 0.5, 0.3, 0.0, 0.0, False, False, False)
Change = Callable[[Inputs], Inputs]


def healthy(tick: int = 0, t_s: float | None = None) -> Inputs:
    """In the air at (0, 0, 1), yaw 0.4; `t_s` for ticks that do not come every 5 ms."""
    t_s = START_S + tick * TICK_S if t_s is None else t_s
    d = 1e-4 * ((tick * 7) % 11 - 5)
    position = (d, -d, 1.0 + d)
    attitude = quat_from_euler_zyx(d, -d, 0.4 + d)
    return Inputs(
        tick=tick,
        t_s=t_s,
        vehicle=VehicleState(
            t_s,
            t_s,
            t_s,
            position,
            (0.05, d, d),
            attitude,
            (0.06, d, d),
            (d, d, 9.81 + d),
            t_s,
            t_s,
            (0.0, 0.0, 9.81 * t_s),
        ),
        status=AutopilotStatus(t_s, True, FlightMode.OFFBOARD, LandedState.IN_AIR, 15.8, 0.9),
        mocap=MocapPose(t_s, 0.005, tick, position, attitude, True, 0.0002, t_s - 0.005),
        arm=ArmState(t_s, (2.0 + d, 1.0 - d), (d, d), (0.5 + d, 0.2 - d), (0, 0), (35.0, 35.0), 0),
        force=ForceSample(t_s, (1.0 + d, -1.0, 0.5), (d, d, d), False),
        command=OperatorCommand.NONE,
        recorder_dropped=0,
    )


def flying(**changes: object) -> Situation:
    situation = Situation(airborne=True, offboard_expected=True, tracking_error_m=0.02, control=control(), tether=SLOW)
    return dataclasses.replace(situation, **changes)  # type: ignore[arg-type]


def standing(**changes: object) -> Situation:
    return dataclasses.replace(Situation(False, False, None), **changes)  # type: ignore[arg-type]


def control(**changes: object) -> ControlLog:
    log = ControlLog(
        ZERO8,
        ZERO8,
        ZERO8,
        ZERO8,
        ZERO8,
        ZERO8,
        (0.0, 0.0, 0.0, 0.0),
        0.0,
        0.0,
        ZERO3,
        ZERO3,
        0.5,
        (False, False, False),
    )
    return dataclasses.replace(log, **changes)  # type: ignore[arg-type]


def put(part: str, **fields: object) -> Change:
    """Replace fields of one part of the inputs: put("arm", read_failures=9)."""

    def change(i: Inputs) -> Inputs:
        return dataclasses.replace(i, **{part: dataclasses.replace(getattr(i, part), **fields)})

    return change


def stopped(*parts: str) -> Change:
    """These parts stay as they were at the start, stamps and all."""
    frozen = healthy()
    return lambda i: dataclasses.replace(i, **{part: getattr(frozen, part) for part in parts})


def watched(
    vehicle: Vehicle, inputs: Iterable[Inputs], situation: Situation, monitors: Monitors | None = None
) -> list[Event]:
    """Events of a whole stream."""
    monitors = monitors or Monitors(vehicle)
    return [event for i in inputs for event in monitors.check(i, situation)]


def after_a_moment(change: Change, ticks: int = 700, sound: int = 3) -> list[Inputs]:
    """Some healthy ticks, then changed ones: 3.5 s."""
    return [healthy(k) if k < sound else change(healthy(k)) for k in range(ticks)]
