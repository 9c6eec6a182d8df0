"""What is done to a broker beside a flight, each in a process of its own: viewers, noise, rubbish.

python -m benchmarks.brokering.load viewers|noise|rubbish URL VEHICLE

The load is niced: viewers and attackers sit on other computers, and here it is the flight that is measured.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import secrets
import signal
import subprocess
import sys
from collections.abc import Awaitable, Callable

import aiohttp
import aiomqtt

from companion.config.ground import broker_address
from companion.ground.messages import MESSAGE_MAX_BYTES, CommandName, Topic

VIEWERS = 20
NOISE_PER_S = 1000
RUBBISH = 2000
_NICE = 10
_URL = re.compile(rb"http://[^\s]+")


async def viewers(url: str, vehicle: str) -> None:
    """`companion monitor` with 20 pages open."""
    del vehicle
    command = [sys.executable, "-m", "companion.cli", "monitor", "--broker", url, "--port", "0"]
    process = await asyncio.create_subprocess_exec(*command, stdout=subprocess.PIPE, env=_unbuffered())
    assert process.stdout is not None
    try:
        page = None
        while page is None:
            line = await process.stdout.readline()
            if not line:
                raise SystemExit("the monitor ended at once")
            found = _URL.search(line)
            page = found[0].decode().partition("#")[0].rstrip("/") if found else None
        async with aiohttp.ClientSession() as session, asyncio.TaskGroup() as group:
            for _ in range(VIEWERS):
                group.create_task(_view(session, page))
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        await process.wait()


async def _view(session: aiohttp.ClientSession, page: str) -> None:
    async with session.ws_connect(f"{page}/ws", headers={"Origin": page}) as socket:
        async for _ in socket:
            pass


async def noise(url: str, vehicle: str) -> None:
    """1,000 messages a second on the command topic: random bytes, and commands whose signature is wrong."""
    topic = Topic.COMMAND.of(vehicle)
    wrong = {
        "v": 1,
        "vehicle": vehicle,
        "session": secrets.token_hex(8),
        "operator": "nobody",
        "command": CommandName.LAND.value,
        "t_ms": 1000,
        "nonce": secrets.token_hex(16),
        "mac": secrets.token_hex(32),
    }
    payloads = [secrets.token_bytes(200), json.dumps(wrong).encode(), b"{" * 900]
    loop = asyncio.get_running_loop()
    async with _client(url) as client:
        step_s, sent = 0.02, 0
        begun_s = due_s = loop.time()
        try:
            while True:
                for _ in range(round(NOISE_PER_S * step_s)):
                    await client.publish(topic, payloads[sent % len(payloads)], qos=0)
                    sent += 1
                due_s += step_s
                await asyncio.sleep(max(0.001, due_s - loop.time()))
        finally:
            print(f"  {sent / (loop.time() - begun_s):.0f} commands a second", flush=True)


async def rubbish(url: str, vehicle: str) -> None:
    """Retained messages of others, and rubbish retained on the vehicle's own topics; then stay."""
    async with _client(url) as client:
        for topic in Topic:
            await client.publish(topic.of(vehicle), secrets.token_bytes(1000), qos=1, retain=True)
        for number in range(RUBBISH):
            await client.publish(f"companion/{number}/state", secrets.token_bytes(1000), qos=0, retain=True)
        await asyncio.Event().wait()


def _client(url: str) -> aiomqtt.Client:
    address = broker_address(url)
    return aiomqtt.Client(
        address.host, address.port, protocol=aiomqtt.ProtocolVersion.V5, max_queued_outgoing_messages=MESSAGE_MAX_BYTES
    )


def _unbuffered() -> dict[str, str]:
    return {**os.environ, "PYTHONUNBUFFERED": "1"}


async def _until_ended(load: Callable[[str, str], Awaitable[None]], url: str, vehicle: str) -> None:
    task = asyncio.ensure_future(load(url, vehicle))
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, task.cancel)
    with contextlib.suppress(asyncio.CancelledError):
        await task


LOADS = {"viewers": viewers, "noise": noise, "rubbish": rubbish}

if __name__ == "__main__":
    os.nice(_NICE)
    asyncio.run(_until_ended(LOADS[sys.argv[1]], sys.argv[2], sys.argv[3]))
