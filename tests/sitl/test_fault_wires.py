"""Faults where they meet a wire: the server's devices, and the link of the fast loop."""

from __future__ import annotations

import asyncio
import json
import subprocess

import pytest

from companion.model.constants import TICK_PERIOD_S
from companion.model.types import AutopilotStatus, FlightMode, LandedState, VehicleState
from companion.sitl_config.faults import Fault, FaultKind
from companion.sitl_config.loader import load_sitl
from sitl.autopilot.backend import StubBackend
from sitl.autopilot.mavlink import Ports as LinkPorts
from sitl.fast.link import FastLink
from sitl.fast.loop import FastFlight
from sitl.faults.processes import OTHER_PROCESS_FAULTS
from sitl.server import Sitl
from sitl.wires import MachineWires, Ports
from sitl.world.start import start_of
from tests.support import CATCH

# -- the server --------------------------------------------------------------------------------------------------------


def test_the_server_begins_and_ends_each_fault_of_a_wire_or_a_process(monkeypatch: pytest.MonkeyPatch) -> None:
    struck: list[FaultKind] = []

    def strike(kind: FaultKind, pid: int) -> bool:
        struck.append(kind)
        return True

    monkeypatch.setattr("sitl.faults.processes.inject_process_fault", strike)
    kinds = ("link_loss", "link_delay", "bus_noise", "bus_delay", "force_loss", "servo_loss", "clock_step")
    sizes = {"link_delay": 0.05, "bus_noise": 1.0, "bus_delay": 0.02, "clock_step": 5.0}
    common = {"after": "start", "t_s": 0.01, "duration_s": 0.02}
    faults = [{**common, "kind": kind, "size": sizes.get(kind)} for kind in (*kinds, *OTHER_PROCESS_FAULTS)]
    config = load_sitl(CATCH, overrides=[f"world.faults={json.dumps([*faults, {**common, 'kind': 'stop_flight'}])}"])
    px4 = StubBackend(config.vehicle.airframe, config.world, LinkPorts(0, 0))
    wires = MachineWires(
        config.vehicle, config.world, start_of((0.0, 0.0), 0.0, (20.0, 20.0)), Ports(), lambda _: None, px4
    )
    server = Sitl([wires])

    def seen() -> tuple[object, ...]:
        link, bus, sensor = px4._mavlink, wires.bus, wires.force
        assert bus is not None and sensor is not None
        silent = wires.servos[0].silent
        return (
            *(link.link_down, link.delay_s, bus.damaged(), bus.answers_late_s, sensor.silent, silent),
            wires.faults.server_clock_s(wires.plant.t_s),
        )

    async def run() -> None:
        async with server.wires():
            for until_s, found in (
                (0.009, (False, 0.0, False, 0.0, False, False, 0.008)),
                (0.02, (True, 0.05, True, 0.02, True, True, 5.02)),
                (0.04, (False, 0.0, False, 0.0, False, False, 0.04)),
            ):
                while wires.plant.t_s < until_s - 0.0015:
                    server._step()
                assert seen() == pytest.approx(found), until_s

    with subprocess.Popen(["sleep", "600"]) as process:
        try:
            wires.flight.pid = process.pid
            asyncio.run(run())
        finally:
            process.kill()
    assert struck == list(OTHER_PROCESS_FAULTS)
    assert wires.flight.kind == "stop_flight"


# -- the link of the fast loop -----------------------------------------------------------------------------------------


@pytest.fixture
def flight() -> FastFlight:
    return FastFlight(load_sitl(CATCH))


@pytest.fixture
def link(flight: FastFlight) -> FastLink:
    return FastLink(flight.faults, flight.plant.scene, flight.px4, TICK_PERIOD_S)


def at_rest(t_s: float) -> tuple[VehicleState, AutopilotStatus]:
    nothing = (0.0, 0.0, 0.0)
    state = VehicleState(
        position_stamp_s=t_s,
        attitude_stamp_s=t_s,
        imu_stamp_s=t_s,
        position_world_m=(t_s, 0.0, 0.0),
        velocity_world_m_s=nothing,
        attitude_wxyz=(1.0, 0.0, 0.0, 0.0),
        angular_rate_body_rad_s=nothing,
        specific_force_body_m_s2=(0.0, 0.0, 9.81),
        boot_s=t_s,
    )
    return state, AutopilotStatus(
        heartbeat_stamp_s=t_s,
        armed=True,
        mode=FlightMode.OFFBOARD,
        landed=LandedState.IN_AIR,
        battery_voltage_v=16.0,
        battery_remaining=1.0,
    )


def test_over_a_slow_link_everything_comes_in_order_and_that_much_later(flight: FastFlight, link: FastLink) -> None:
    world = flight.plant.scene
    arrived: list[tuple[float, float]] = []
    flight.faults.active["link_delay"] = Fault(kind="link_delay", t_s=0.0, size=0.05)
    for tick in range(40):
        world.t_s = t_s = round(tick * TICK_PERIOD_S, 4)
        link.deliver_due()
        link.send(lambda sent_s=t_s: arrived.append((sent_s, world.t_s)))  # type: ignore[misc]
        state, heard = link.receive(*at_rest(t_s))
        assert state is not None and heard is not None
        if tick >= 10:
            assert state.position_world_m[0] == state.boot_s == pytest.approx(t_s - 0.05), "what was sent then"
            assert state.attitude_stamp_s == heard.heartbeat_stamp_s == pytest.approx(t_s), "but it arrives now"
    assert [sent_s for sent_s, _ in arrived] == pytest.approx([tick * TICK_PERIOD_S for tick in range(30)])
    assert all(at_s - sent_s == pytest.approx(0.05) for sent_s, at_s in arrived)


def test_a_link_that_slows_down_in_flight_delivers_nothing_twice(flight: FastFlight, link: FastLink) -> None:
    """Its messages keep their order: while the delay grows, the last state stays."""
    heard: list[float | None] = []
    for tick in range(60):
        flight.plant.scene.t_s = t_s = round(tick * TICK_PERIOD_S, 4)
        if tick == 20:
            flight.faults.active["link_delay"] = Fault(kind="link_delay", t_s=0.0, size=0.05)
        if tick == 40:
            flight.faults.active.clear()
        state, _ = link.receive(*at_rest(t_s))
        assert state is not None
        heard.append(state.boot_s)
    ticks = [round(boot_s / TICK_PERIOD_S) for boot_s in heard if boot_s is not None]
    assert ticks == [*range(20), *[19] * 10, *range(20, 30), *range(40, 60)]
