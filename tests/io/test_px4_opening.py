"""The MAVSDK edge opens and closes its link: parameters, origin, streams, and what it refuses."""

from __future__ import annotations

import asyncio
import logging
import math
import socket
import time
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.io.protocols import DeviceError
from companion.io.px4 import params as autopilot_params
from companion.io.px4 import questions
from companion.model.estimator import EstimatorReport
from companion.model.types import AttitudeSetpoint, AutopilotRequest
from tests.io.px4_peer import PARAMS, Px4Peer
from tests.io.test_px4 import ARM_DISARM, armed, edge, linked, refused
from tests.support import eventually, free_udp_port
from tests.wires import serial_line

ASK_ORIGIN = mavlink.MAV_CMD_REQUEST_MESSAGE


async def test_parameters_and_firmware_are_read_from_the_wire_and_parameters_written() -> None:
    async with linked() as (peer, autopilot):
        peer.deaf_to = {"COM_RC_IN_MODE", "SDLOG_MODE"}
        read = await autopilot.read_params([*PARAMS, "NO_SUCH_ONE", "NOR_THIS"])
        assert read == PARAMS
        assert {name: type(value) for name, value in read.items()} == {n: type(v) for n, v in PARAMS.items()}
        assert await autopilot.read_param("MPC_THR_HOVER") == PARAMS["MPC_THR_HOVER"]
        assert (await autopilot.firmware()).startswith("PX4 1.16.1 release (git 01234567")
        with pytest.raises(DeviceError, match="1 to 16 of the characters A-Z"):
            await autopilot.read_params(["MPC_THR_HOVER", "lower case"])
        for name, value in (("MPC_THR_HOVER", 0.49), ("SDLOG_MODE", 2), ("COM_RC_IN_MODE", -1)):
            written = await autopilot.write_param(name, value)
            assert written == peer.params[name] == pytest.approx(value, rel=1e-7)
            assert type(written) is type(PARAMS[name])
        with pytest.raises(DeviceError, match=r"a whole number for COM_RC_IN_MODE, an INT32, found 1\.5"):
            await autopilot.write_param("COM_RC_IN_MODE", 1.5)
        with pytest.raises(DeviceError, match="NO_SUCH_ONE, found no such parameter"):
            await autopilot.write_param("NO_SUCH_ONE", 1)


async def test_a_silent_px4_does_not_pass_for_one_without_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(autopilot_params, "READ_DEADLINE_S", 2.0)

    async with linked() as (peer, autopilot):
        peer.params.clear()
        with pytest.raises(DeviceError, match=r"PX4's parameters \(2 names, the first COM_RC_IN_MODE\), found 0"):
            await autopilot.read_params(["COM_RC_IN_MODE", "SDLOG_MODE"])


async def test_a_whole_export_with_unknown_names_is_read_to_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each group of eight unknown names takes 0.4 s, and all of them longer than the deadline for one answer."""
    monkeypatch.setattr(autopilot_params, "ASKS", 1)
    monkeypatch.setattr(autopilot_params, "READ_DEADLINE_S", 2.0)
    async with linked() as (peer, autopilot):
        peer.params = PARAMS | {f"P_{number}": number for number in range(60)}
        unknown = [f"NO_{number}" for number in range(autopilot_params.WINDOW * 6)]
        assert await autopilot.read_params([*unknown, *peer.params]) == peer.params


async def test_px4_without_an_origin_is_given_one_unless_it_is_armed() -> None:
    async with linked() as (peer, autopilot):
        assert await autopilot.ensure_origin()
        assert peer.of("SET_GPS_GLOBAL_ORIGIN") == [], "it has one"
        peer.origin = None
        peer.base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        await eventually(lambda: armed(autopilot), "armed")
        assert not await autopilot.ensure_origin() and peer.origin is None
        peer.base_mode &= ~mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        await eventually(lambda: not armed(autopilot), "disarmed")
        assert await autopilot.ensure_origin()
        origin: Any = peer.origin
        assert (origin.latitude, origin.longitude, origin.altitude) == (
            0,
            0,
            0,
        )  # any other moves EKF2's local position
        assert origin.target_system == 1


@pytest.mark.parametrize(
    ("forwarding", "armed", "interval_us"), [(False, False, -1.0), (True, False, 0.0), (False, True, None)]
)
async def test_streams_without_a_reader_are_stopped(forwarding: bool, armed: bool, interval_us: float | None) -> None:
    port = free_udp_port()
    with Px4Peer(port) as peer:
        peer.base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
        unread = (mavlink.MAVLINK_MSG_ID_ATTITUDE, mavlink.MAVLINK_MSG_ID_ODOMETRY)
        async with edge(port, forwarding=forwarding):
            if not armed:
                await eventually(lambda: all(stream in peer.asked_interval_us for stream in unread), "streams stopped")
        peer.packets_so_far()
        assert [peer.asked_interval_us.get(stream) for stream in unread] == [interval_us, interval_us]
        assert peer.asked_interval_us[mavlink.MAVLINK_MSG_ID_HIGHRES_IMU] > 0.0


async def test_estimator_status_is_asked_for_and_reported() -> None:
    async with linked() as (peer, autopilot):
        assert autopilot.estimator() is None
        peer.estimator = (0x33F, math.nan, 0.25, 0.125, 0.0, 0.0, 0.0, 0.0625, math.nan)
        await eventually(lambda: autopilot.estimator() is not None, "ESTIMATOR_STATUS")
        report = autopilot.estimator()
        assert report is not None
        # PX4 says NaN of a velocity that it does not fuse, and of what it does not know.
        assert report == EstimatorReport(
            stamp_s=report.stamp_s,
            flags=0x33F,
            velocity_ratio=0.0,
            position_horizontal_ratio=0.25,
            position_vertical_ratio=0.125,
            position_horizontal_accuracy_m=0.0625,
            position_vertical_accuracy_m=math.inf,
        )
        assert peer.asked_interval_us[mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS] == pytest.approx(200_000.0)
        await eventually(lambda: autopilot.estimator() != report, "a newer one")


async def test_nothing_is_sent_any_more_once_the_edge_is_left_and_its_port_is_free() -> None:
    port = free_udp_port()
    with Px4Peer(port) as peer:
        peer.acks[ARM_DISARM] = None
        autopilot = edge(port)
        async with autopilot:
            for _ in range(10):
                assert autopilot.send_attitude(AttitudeSetpoint((1.0, 0.0, 0.0, 0.0), 0.5))
            await asyncio.to_thread(peer.wait_for, "SET_ATTITUDE_TARGET", 10)
            # Nor is anything re-sent while the companion hangs: PX4's own offboard-loss failsafe has to see silence.
            await asyncio.sleep(0.5)
            assert peer.packets_so_far() > 0
            assert len(peer.of("SET_ATTITUDE_TARGET")) == 10
            autopilot.request(AutopilotRequest.ARM)
            await eventually(lambda: bool(peer.commands(ARM_DISARM)), "ARM, which hangs")
        left = peer.packets_so_far()
        await asyncio.sleep(1.5)  # longer than the period of every stream: setpoints 20 Hz, heartbeats 1 Hz
        assert peer.packets_so_far() == left
        assert autopilot.send_attitude(AttitudeSetpoint((1.0, 0.0, 0.0, 0.0), 0.5)) is False
        autopilot.request(AutopilotRequest.LAND)
        assert peer.packets_so_far() == left
        async with edge(port):
            pass


async def test_what_is_no_px4_or_no_usable_address_is_one_line(tmp_path: Path) -> None:
    free, ardupilot = free_udp_port(), free_udp_port()
    plain = tmp_path / "plain"
    plain.touch()
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
        Px4Peer(ardupilot, autopilot=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA),
        serial_line() as (_, port),
    ):
        # MAVSDK would share the port.
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        other.bind(("127.0.0.1", 0))
        busy = other.getsockname()[1]
        for address, found in (
            (f"udpin://127.0.0.1:{free}", "a PX4 heartbeat within 0.3 s, found none"),
            (f"udpin://127.0.0.1:{busy}", f"port {busy} to be free, found another program"),
            ("udpin://192.0.2.1:14540", "a local address in 192.0.2.1"),  # TEST-NET-1
            (
                "serial:///dev/no-such-autopilot:921600",
                "the serial port /dev/no-such-autopilot, found No such file or directory",
            ),
            (f"serial://{plain}:921600", "no device file"),
            (f"serial://{port}:123", "to open the connection"),  # a baud rate that no port has
        ):
            assert found in await refused(address, discovery_timeout_s=0.3)
        assert "expected PX4, found ARDUPILOT" in await refused(f"udpin://127.0.0.1:{ardupilot}")


async def test_cancelling_the_wait_for_a_heartbeat_leaves_no_port_behind() -> None:
    port = free_udp_port()
    entering = asyncio.create_task(edge(port).__aenter__())
    await asyncio.sleep(0.2)
    entering.cancel()
    with pytest.raises(asyncio.CancelledError):
        await entering
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as again:
        again.bind(("127.0.0.1", port))


def test_mavsdks_own_log_goes_to_python_logging_and_not_to_the_terminal(
    capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    async def fly() -> None:
        async with linked() as (_, _):
            pass

    with caplog.at_level(logging.DEBUG, logger="companion.mavsdk"):
        asyncio.run(fly())
    assert any("MAVSDK version" in record.message for record in caplog.records)
    captured = capfd.readouterr()
    assert captured.out == captured.err == ""


async def test_a_question_is_repeated_until_it_is_answered() -> None:
    async with linked() as (peer, autopilot):
        peer.acks[ASK_ORIGIN] = None
        before = len(peer.commands(ASK_ORIGIN))
        asking = asyncio.create_task(autopilot.ensure_origin())
        await eventually(lambda: len(peer.commands(ASK_ORIGIN)) >= before + 2, "the question, twice")
        peer.acks[ASK_ORIGIN] = mavlink.MAV_RESULT_ACCEPTED
        assert await asking


async def test_a_question_that_px4_never_answers_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(questions, "ASKS", 2)

    async with linked() as (peer, autopilot):
        peer.acks[ASK_ORIGIN] = None
        with pytest.raises(DeviceError, match=r"global origin, found no answer within 1 s; check the link$"):
            await autopilot.ensure_origin()


class _SlowLoop(asyncio.SelectorEventLoop):
    """Its clock runs at a fiftieth of the computer's, as simulated time does on a computer that is very busy."""

    def time(self) -> float:
        return time.monotonic() / 50.0


def test_on_a_slow_clock_a_late_answer_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(questions, "ASKS", 1)

    async def fly() -> None:
        async with linked() as (peer, autopilot):
            peer.acks[ASK_ORIGIN] = None
            before = len(peer.commands(ASK_ORIGIN))
            asking = asyncio.create_task(autopilot.ensure_origin())
            await eventually(lambda: len(peer.commands(ASK_ORIGIN)) > before, "the question")
            await asyncio.to_thread(time.sleep, 2 * questions.REPEAT_S)
            peer.say(mavlink.MAVLink_command_ack_message(ASK_ORIGIN, mavlink.MAV_RESULT_ACCEPTED))
            assert await asking

    with asyncio.Runner(loop_factory=_SlowLoop) as runner:
        runner.run(fly())
