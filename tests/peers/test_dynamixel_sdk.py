"""The unmodified dynamixel-sdk against the emulated bus on its pty."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from dynamixel_sdk import (
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    GroupSyncRead,
    GroupSyncWrite,
    PacketHandler,
    PortHandler,
    port_handler,
)

from sitl.servo.bus import ServoBus
from sitl.servo.model import RAD_PER_COUNT, ServoModel

BAUD = 1_000_000
IDS = (11, 12)


def on_bus(talk: Callable[[Any, Any], None], servos: list[ServoModel]) -> None:
    """Run `talk(port, protocol)` in a thread, with the SDK's own port, while this loop serves the bus."""

    patience = port_handler.LATENCY_TIMER

    def session(path: str) -> None:
        # Only patience, for a loaded machine: the SDK gives a servo 34 ms of wall time, in one process with this bus.
        port_handler.LATENCY_TIMER = 500
        port = PortHandler(path)
        port.baudrate = BAUD
        assert port.openPort()
        try:
            talk(port, PacketHandler(2.0))
        finally:
            port.closePort()
            port_handler.LATENCY_TIMER = patience

    async def scenario() -> None:
        async with ServoBus(servos, wire_time=True) as bus:
            await asyncio.to_thread(session, bus.path)

    asyncio.run(scenario())


def servos(*counts: int) -> list[ServoModel]:
    return [
        ServoModel(i, baud_bps=BAUD, shaft_angle_rad=count * RAD_PER_COUNT)
        for i, count in zip(IDS, counts, strict=True)
    ]


def test_ping_and_broadcast_ping_find_both_servos() -> None:
    def talk(port: Any, protocol: Any) -> None:
        assert protocol.ping(port, 11) == (1030, COMM_SUCCESS, 0)
        assert protocol.ping(port, 13)[1] == COMM_RX_TIMEOUT
        found, result = protocol.broadcastPing(port)
        assert result == COMM_SUCCESS
        assert found == {11: [1030, 48], 12: [1030, 48]}

    on_bus(talk, servos(100, 200))


def test_a_sync_read_returns_the_values_of_all_servos() -> None:
    def talk(port: Any, protocol: Any) -> None:
        sync = GroupSyncRead(port, protocol, 126, 10)
        for i in IDS:
            assert sync.addParam(i)
        assert sync.txRxPacket() == COMM_SUCCESS
        assert [sync.getData(i, 132, 4) for i in IDS] == [0x0AFD, 2079]
        assert [sync.getData(i, 128, 4) for i in IDS] == [0xFFFFFFFF, 0], "-1, unsigned as the SDK has it"

    pair = servos(0x0AFD, 2079)
    pair[0].update(0.0, 0x0AFD * RAD_PER_COUNT, -0.024)  # velocity FFFFFFFF before position FD0A: has to be stuffed
    on_bus(talk, pair)


def test_writes_single_and_synchronous() -> None:
    def talk(port: Any, protocol: Any) -> None:
        for i in IDS:
            assert protocol.write1ByteTxRx(port, i, 11, 0) == (COMM_SUCCESS, 0)
            assert protocol.write1ByteTxRx(port, i, 64, 1) == (COMM_SUCCESS, 0)
        sync = GroupSyncWrite(port, protocol, 102, 2)
        assert sync.addParam(11, [0x9C, 0xFF])
        assert sync.addParam(12, [200, 0])
        assert sync.txPacket() == COMM_SUCCESS
        assert protocol.read2ByteTxRx(port, 11, 102) == (0xFF9C, COMM_SUCCESS, 0)
        assert protocol.read2ByteTxRx(port, 12, 102) == (200, COMM_SUCCESS, 0)

    on_bus(talk, servos(0, 0))


def test_hardware_error_alerts_in_every_packet_until_reboot() -> None:
    pair = servos(0, 0)
    pair[0].trip_overload()

    def talk(port: Any, protocol: Any) -> None:
        assert protocol.read1ByteTxRx(port, 11, 70) == (0x20, COMM_SUCCESS, 0x80)
        assert protocol.write1ByteTxRx(port, 11, 64, 1) == (COMM_SUCCESS, 0x81)
        assert protocol.reboot(port, 11) == (COMM_SUCCESS, 0)
        assert protocol.write1ByteTxRx(port, 11, 64, 1) == (COMM_SUCCESS, 0)

    on_bus(talk, pair)
