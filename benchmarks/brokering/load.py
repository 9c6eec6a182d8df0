"""Loads on a broker beside a flight, each in a separate process: viewers, one browser, noise, retained garbage.

python -m benchmarks.brokering.load viewers|person|noise|garbage URL VEHICLE

The load is niced, because viewers and attackers would run on other computers.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import secrets
import shutil
import signal
import subprocess
import sys
from collections.abc import AsyncIterator, Awaitable, Callable

import aiohttp
import aiomqtt

from companion.config.ground import broker_address
from companion.ground.protocol.messages import MESSAGE_MAX_BYTES, CommandName, Topic
from tests.browser import ARGUMENTS

VIEWERS = 20
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
NOISE_PER_S = 1000
GARBAGE = 2000
_NICE = 10
_URL = re.compile(rb"http://[^\s]+")


async def viewers(url: str, vehicle: str) -> None:
    """Run `companion monitor` with 20 open pages."""
    del vehicle
    async with _monitor(url) as address, aiohttp.ClientSession() as session, asyncio.TaskGroup() as group:
        for _ in range(VIEWERS):
            group.create_task(_view(session, address))


async def person(url: str, vehicle: str) -> None:
    """Run `companion monitor` with its page in a browser, else with one WebSocket; print which, and what it showed."""
    del vehicle
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    async with _monitor(url) as address:
        if browser is None:
            print("a WebSocket client (no chromium here)", flush=True)
            async with aiohttp.ClientSession() as session:
                await _view(session, address)
            return
        from playwright.async_api import async_playwright

        async with async_playwright() as playwright:
            started = await playwright.chromium.launch(
                executable_path=browser, args=list(ARGUMENTS), handle_sigterm=False
            )
            try:
                page = await started.new_page(viewport={"width": 1440, "height": 900})
                await page.goto(address)
                print(f"headless Chromium {started.version}", flush=True)
                await page.locator("#word", has_text="FLYING").wait_for(timeout=0)
                print("its page showed FLYING", flush=True)
                await asyncio.Event().wait()
            finally:
                await started.close()


@contextlib.asynccontextmanager
async def _monitor(url: str) -> AsyncIterator[str]:
    """Run `companion monitor` on a free port and yield the address of its page with the token."""
    command = [sys.executable, "-m", "companion", "monitor", "--broker", url, "--port", "0"]
    process = await asyncio.create_subprocess_exec(*command, stdout=subprocess.PIPE, env=_unbuffered())
    assert process.stdout is not None
    try:
        address = None
        while address is None:
            line = await process.stdout.readline()
            if not line:
                raise SystemExit("the monitor ended at once")
            found = _URL.search(line)
            address = found[0].decode() if found else None
        yield address
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        await process.wait()


async def _view(session: aiohttp.ClientSession, address: str) -> None:
    page = address.partition("#")[0].rstrip("/")
    async with session.ws_connect(f"{page}/ws", headers={"Origin": page}) as socket:
        async for _ in socket:
            pass


async def noise(url: str, vehicle: str) -> None:
    """Send 1,000 messages a second to the command topic: random bytes, and commands with a wrong signature."""
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


async def garbage(url: str, vehicle: str) -> None:
    """Retain messages on other topics and garbage on the vehicle's own topics, then stay connected."""
    async with _client(url) as client:
        for topic in Topic:
            await client.publish(topic.of(vehicle), secrets.token_bytes(1000), qos=1, retain=True)
        for number in range(GARBAGE):
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


LOADS = {"viewers": viewers, "person": person, "noise": noise, "garbage": garbage}

if __name__ == "__main__":
    os.nice(_NICE)
    asyncio.run(_until_ended(LOADS[sys.argv[1]], sys.argv[2], sys.argv[3]))
