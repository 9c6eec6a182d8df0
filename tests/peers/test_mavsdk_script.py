"""An unmodified MAVSDK 4 script in a separate process flies the PX4 stub: arm, take off, offboard, land, disarm."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path
from typing import Any

import pytest

from sitl.autopilot.mavlink import MavlinkServer, Ports
from sitl.autopilot.modes import NavState
from tests.sitl.px4_rig import Rig
from tests.support import DEADLINE_S, free_udp_port

SCRIPT = Path(__file__).with_name("mavsdk_mission.py")


async def fly_script(rig: Rig) -> tuple[int, list[dict[str, Any]], str, float]:
    """Run the script; return exit code, steps, standard error and greatest height."""
    port = free_udp_port()
    stop = asyncio.Event()
    highest_m = 0.0

    async def watch() -> None:
        nonlocal highest_m
        while not stop.is_set():
            highest_m = max(highest_m, rig.height_m)
            await asyncio.sleep(0.02)

    async with MavlinkServer(rig.stub, Ports(0, port)) as server, asyncio.TaskGroup() as group:
        group.create_task(rig.fly(server, stop))
        group.create_task(watch())
        script = await asyncio.create_subprocess_exec(
            sys.executable,
            str(SCRIPT),
            f"udpin://127.0.0.1:{port}",
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        try:
            out, err = await asyncio.wait_for(script.communicate(), DEADLINE_S)
        except TimeoutError:
            script.kill()
            out, err = await script.communicate()
        finally:
            stop.set()
            if script.returncode is None:
                script.kill()
    steps = [json.loads(line) for line in out.decode().splitlines() if line.startswith("{")]
    return script.returncode or 0, steps, err.decode(), highest_m


@pytest.mark.timeout(200)
def test_a_mavsdk_script_flies_the_stub() -> None:
    rig = Rig()
    code, steps, errors, highest_m = asyncio.run(fly_script(rig))
    by_name = {step["step"]: step for step in steps}
    assert code == 0, f"after {list(by_name)}: {errors[-2000:]}"
    assert (by_name["version"]["major"], by_name["version"]["minor"]) == (1, 16)
    assert by_name["params"]["count"] == len(rig.params)
    assert by_name["params"]["changed"] == 5 == rig.params.integer("COM_OBL_RC_ACT")
    assert by_name["params"]["hover"] == pytest.approx(0.5)
    assert by_name["offboard position"]["north"] == pytest.approx(0.5, abs=0.1)
    assert by_name["offboard attitude"]["roll"] < -3.0
    assert by_name["offboard attitude"]["active"] is True
    assert by_name["landed"]["mode"] == "OFFBOARD", "as PX4: after landing it is back where it came from"
    assert rig.stub.nav_state is NavState.OFFBOARD
    assert rig.stub.armed is False
    assert highest_m == pytest.approx(1.2, abs=0.25)
    assert rig.height_m == pytest.approx(0.0, abs=1e-3)
