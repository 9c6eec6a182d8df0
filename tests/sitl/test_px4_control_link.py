"""The world's own MAVLink link to PX4, against the stub on the ports where PX4's camera link is; and the relay for link faults."""

from __future__ import annotations

import asyncio
import contextlib
import math
import socket
from collections.abc import AsyncIterator

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.config.loader import load_vehicle
from companion.sitl_config.effects.battery import Battery as BatteryConfig
from companion.sitl_config.faults import Fault
from companion.sitl_config.world import World
from sitl.autopilot.mavlink import MavlinkServer, Ports
from sitl.autopilot.modes import NavState
from sitl.autopilot.types import Battery
from sitl.px4.backend import refuse_stub_only_settings
from sitl.px4.control_link import ControlLink, same
from sitl.px4.hil_link import Px4Error
from sitl.px4.parameters import parameters, rotor_geometry
from sitl.px4.process import Instance, abandoned_instance, how_to_start_it
from sitl.px4.relay import Relay
from tests.sitl.px4_rig import Rig
from tests.support import DEADLINE_S

VEHICLE = load_vehicle("configs/vehicles/tarot650_2r.yaml")


@contextlib.asynccontextmanager
async def connected() -> AsyncIterator[tuple[ControlLink, Rig]]:
    with Instance.claim() as instance:
        rig = Rig({"MAV_SYS_ID": instance.number + 1})
        port = instance.control.getsockname()[1]
        stop = asyncio.Event()
        async with (
            MavlinkServer(rig.stub, Ports(instance.control_address[1], port)) as server,
            asyncio.TaskGroup() as group,
        ):
            group.create_task(rig.fly(server, stop))
            try:
                async with ControlLink(instance, 4) as control:
                    yield control, rig
            finally:
                stop.set()


async def test_parameters_are_written_by_type_and_read_back() -> None:
    async with connected() as (control, rig):
        await control.await_heartbeat()
        await control.write({"EKF2_EV_CTRL": 15, "MPC_THR_HOVER": 0.43, "COM_OF_LOSS_T": 0.3})
        assert rig.params["EKF2_EV_CTRL"] == 15
        assert rig.params["MPC_THR_HOVER"] == pytest.approx(0.43)
        found = await control.read(["EKF2_EV_CTRL", "MPC_THR_HOVER", "NO_SUCH_NAME"])
        assert set(found) == {"EKF2_EV_CTRL", "MPC_THR_HOVER"}
        assert same(found["MPC_THR_HOVER"], 0.43)
        assert found["EKF2_EV_CTRL"] == 15 and isinstance(found["EKF2_EV_CTRL"], int)


async def test_a_parameter_that_is_not_taken_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sitl.px4.control_link.PARAMS_DEADLINE_S", 0.5)
    async with connected() as (control, _):
        await control.await_heartbeat()
        with pytest.raises(Px4Error, match="expected EKF2_EV_CTRL to become 15, found 11"):
            await control.write({"EKF2_EV_CTRL": 15.0})  # of the wrong type: PX4 ignores it


async def test_a_px4_that_is_not_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sitl.px4.control_link.HEARTBEAT_DEADLINE_S", 0.3)
    with Instance.claim() as instance:
        async with ControlLink(instance, 4) as control:
            with pytest.raises(Px4Error, match="expected a heartbeat on UDP"):
                await control.await_heartbeat()


async def test_a_mode_is_chosen_and_seen() -> None:
    async with connected() as (control, rig):
        await control.await_heartbeat()
        control.request_mode(NavState.LAND)
        async with asyncio.timeout(DEADLINE_S):
            while control.nav_state is not NavState.LAND:
                await control.await_heartbeat()
        assert rig.stub.nav_state is NavState.LAND


def test_the_geometry_is_that_of_the_world_and_that_of_a_hexacopter_that_of_px4s_airframe() -> None:
    """Front right first, turning counter-clockwise; FRD, so right is positive."""
    geometry = rotor_geometry(VEHICLE.airframe.model_copy(update={"rotor_arm_m": 0.2, "yaw_torque_per_thrust_m": 0.03}))
    offset = 0.2 / math.sqrt(2.0)
    places = [(geometry[f"CA_ROTOR{i}_PX"], geometry[f"CA_ROTOR{i}_PY"]) for i in range(4)]
    assert places == [(offset, offset), (-offset, -offset), (offset, -offset), (-offset, offset)]
    assert [geometry[f"CA_ROTOR{i}_KM"] for i in range(4)] == [0.03, 0.03, -0.03, -0.03]
    assert (geometry["CA_ROTOR_COUNT"], geometry["MAV_TYPE"], geometry["CA_ROTOR0_PZ"]) == (4, 2, -0.03)
    geometry = rotor_geometry(VEHICLE.airframe.model_copy(update={"layout": "hexa_x", "rotor_arm_m": 0.5}))
    assert (geometry["CA_ROTOR_COUNT"], geometry["MAV_TYPE"]) == (6, 13)
    assert (geometry["CA_ROTOR0_PX"], geometry["CA_ROTOR0_PY"]) == (0.0, 0.5)
    assert (geometry["CA_ROTOR5_PX"], geometry["CA_ROTOR5_PY"]) == pytest.approx((-0.433, -0.25), abs=1e-3)
    assert [geometry[f"PWM_MAIN_FUNC{i + 1}"] for i in range(6)] == [101, 102, 103, 104, 105, 106]
    assert [geometry[f"CA_ROTOR{i}_KM"] for i in range(6)] == [-0.025, 0.025, -0.025, 0.025, 0.025, -0.025]


def test_every_other_fault_is_flown() -> None:
    refuse_stub_only_settings(World(faults=(Fault(kind="link_delay", t_s=1.0), Fault(kind="kill_flight", t_s=1.0))))
    with pytest.raises(Px4Error, match=r"arming_refused .*run with --sitl"):
        refuse_stub_only_settings(World(faults=(Fault(kind="arming_refused", t_s=1.0),)))
    with pytest.raises(Px4Error, match="battery_start"):
        refuse_stub_only_settings(World(battery_start=0.5))
    sag = Fault(kind="battery_sag", t_s=1.0)
    refuse_stub_only_settings(World(battery_start=0.5, battery=BatteryConfig(on=True), faults=(sag,)))


def test_a_battery_of_the_world_takes_the_place_of_px4s_own() -> None:
    own = parameters(VEHICLE.airframe, World(battery_life_s=600.0), 0.5)
    assert (own["SIM_BAT_ENABLE"], own["SIM_BAT_DRAIN"]) == (1, 600.0)
    worlds = parameters(VEHICLE.airframe, World(battery=BatteryConfig(on=True)), 0.5)
    assert (worlds["SIM_BAT_ENABLE"], worlds["SIM_BAT_DRAIN"]) == (0, 0.0), "the second for 1.18, which lacks the first"


def test_the_supply_check_stays_as_the_simulator_has_it() -> None:
    """PX4 1.15's simulator has no supply voltage: with the check on, as vehicles want it, it did not arm."""
    assert "CBRK_SUPPLY_CHK" not in parameters(VEHICLE.airframe, World(), 0.5)


def test_a_px4_started_by_hand_that_still_runs_after_its_flight_is_found() -> None:
    with Instance.claim() as instance, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(instance.onboard_address)
        assert abandoned_instance() != instance.number, "its world is there: it flies"
        instance.simulator.close()
        assert abandoned_instance() == instance.number
    assert abandoned_instance() != instance.number
    assert "make" in how_to_start_it(0) and "px4 -i 3`" in how_to_start_it(3) and "make" not in how_to_start_it(3)


async def test_the_battery_is_sent_with_px4s_system_id_and_another_component_id() -> None:
    loop = asyncio.get_running_loop()
    with Instance.claim() as instance, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as px4:
        px4.bind(instance.control_address)
        px4.setblocking(False)
        async with ControlLink(instance, 4) as control, asyncio.timeout(DEADLINE_S):
            control.send_battery(Battery(15.2, 21.5, 0.8, 640.0))
            (message,) = mavlink.MAVLink(None).parse_buffer(await loop.sock_recv(px4, 512))
        assert message.get_type() == "BATTERY_STATUS"
        assert message.get_srcSystem() == instance.number + 1
        assert message.get_srcComponent() != mavlink.MAV_COMP_ID_AUTOPILOT1, "PX4 ignores its own"
    assert message.voltages == [3800] * 4 + [0xFFFF] * 6
    assert (message.current_battery, message.current_consumed, message.battery_remaining) == (2150, 640, 80)


async def test_the_relay_passes_on_both_ways_until_it_is_down() -> None:
    loop = asyncio.get_running_loop()
    with Instance.claim() as instance, contextlib.ExitStack() as stack:
        px4, companion = (stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2))
        px4.bind(instance.onboard_address)
        for end in (px4, companion):
            end.setblocking(False)
        relay = Relay(instance)
        async with relay.opened() as address, asyncio.timeout(DEADLINE_S):
            host, port = address.removeprefix("udpout://").split(":")
            companion.connect((host, int(port)))
            companion.send(b"up")
            data, source = await loop.sock_recvfrom(px4, 100)
            assert (data, source[1]) == (b"up", instance.onboard_port)
            px4.sendto(b"down", source)
            assert await loop.sock_recv(companion, 100) == b"down"
            relay.down = True
            companion.send(b"lost")
            px4.sendto(b"lost", source)
            await asyncio.sleep(0)
            relay.delay_s = 0.01
            while relay.datagrams < 4:  # noqa: ASYNC110 - a datagram that is dropped sets no event
                await asyncio.sleep(0.001)
            relay.down = False
            companion.send(b"late")
            assert await loop.sock_recv(px4, 100) == b"late", "what came while it was down is lost"
            px4.sendto(b"late", source)
            assert await loop.sock_recv(companion, 100) == b"late"
