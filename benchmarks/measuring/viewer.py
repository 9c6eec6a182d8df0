"""A viewer of a flight: `companion monitor` with its page in a browser, or with one WebSocket without a browser.

python -m benchmarks.measuring.viewer URL                 # prints the kind of viewer and its display, until SIGTERM

The process is niced, because a viewer runs on another computer.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import AsyncIterator

import aiohttp

from tests.browser import ARGUMENTS

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
_NICE = 10
_URL = re.compile(rb"http://[^\s]+")


async def view(broker_url: str) -> None:
    """Watch until cancelled."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    async with _monitor(broker_url) as address:
        if browser is None:
            print("a WebSocket client (no chromium here)", flush=True)
            origin = address.partition("#")[0].rstrip("/")
            headers = {"Origin": origin}
            async with (
                aiohttp.ClientSession() as session,
                session.ws_connect(f"{origin}/ws", headers=headers) as socket,
            ):
                async for _ in socket:
                    pass
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
async def _monitor(broker_url: str) -> AsyncIterator[str]:
    """Run `companion monitor` on a free port and yield the address of its page with the token."""
    command = [sys.executable, "-m", "companion", "monitor", "--broker", broker_url, "--port", "0"]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    process = await asyncio.create_subprocess_exec(*command, stdout=subprocess.PIPE, env=environment)
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


async def _until_ended(broker_url: str) -> None:
    task = asyncio.ensure_future(view(broker_url))
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, task.cancel)
    with contextlib.suppress(asyncio.CancelledError):
        await task


if __name__ == "__main__":
    os.nice(_NICE)
    asyncio.run(_until_ended(sys.argv[1]))
