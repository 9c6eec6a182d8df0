"""`companion ft check` and `tare` over real wires: a known weight hangs on the simulated net; what is planted is found."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest

from companion.config.devices import ForceDevice
from companion.config.loader import load_vehicle
from companion.io.force_torque.driver import RobotousForceTorque
from companion.model.exit_codes import EXIT_ABORTED, EXIT_OK, EXIT_REFUSED
from companion.runtime.clock import flight_clock
from sitl.force_torque import ForceTorqueServer
from tests.commissioning.test_mocap_wires import VEHICLE, bad, changes, document, vehicle
from tests.support import Sandbox, World, run_here, tool_of

__all__ = ["vehicle"]
WEIGHT_KG = 0.5
HUNG_S = 5.0
"""After the first reading: well after the look at the empty net."""
HUNG = (f"world.net_weight_kg={WEIGHT_KG}", f"world.net_weight_t_s={HUNG_S}")


def test_a_sound_sensor_feels_the_weight_as_it_is(sandbox: Sandbox) -> None:
    with World(sandbox, overrides=HUNG) as world:
        ended = sandbox.run("ft", "check", "--weight", WEIGHT_KG, "--json", "--vehicle", VEHICLE, *world.addresses())
    found = document(ended)
    assert ended.code == EXIT_OK, ended
    assert found["weight"]["scale"] == pytest.approx(1.0, abs=0.02)
    assert found["weight"]["off_deg"] < 2.0
    assert found["weight"]["certain"]
    assert found["rest"]["bias_n"] == pytest.approx([1.2, -0.8, 2.5], abs=0.1)
    assert found["rest"]["arm_deg"] == pytest.approx([165.0, 140.0], abs=1.0)
    assert found["patch"] is None


def test_bias_turn_and_scale_are_found_without_the_arm_and_the_turn_is_written(sandbox: Sandbox, vehicle: Path) -> None:
    knobs = ("world.force_bias_n=[30,0,0]", "world.force_scale=2.0", "vehicle.tool.sensor_rpy_deg=[0,0,90]")
    with World(sandbox, overrides=[*HUNG, *knobs]) as world:
        words = ["ft", "check", "--vehicle", vehicle, *world.addresses(arm={"port": "/dev/null"})]
        given = ("--weight", WEIGHT_KG, "--arm-pose", "165,140")
        found = document(run_here(*words, *given, "--json", "--write", "--yes"))
        without_arm = run_here(*words)
    fixes = bad(found)
    assert set(fixes) - {"force.rate"} == {"force.tare", "ft.direction", "ft.scale"}
    assert "companion ft tare --sensor" in fixes["force.tare"]
    assert "2.00 times the true force" in fixes["ft.scale"]
    assert changes(found) == {"tool.sensor_rpy_deg": [0.0, 0.0, 90.0]}
    assert tool_of(load_vehicle(vehicle)).sensor_rpy_deg == (0.0, 0.0, 90.0)
    assert without_arm.code == EXIT_REFUSED
    assert "--arm-pose A1,A2" in without_arm.out


def test_tare_shows_the_drift_and_writes_to_the_sensor_only_when_asked(
    sandbox: Sandbox, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.cli.ft.number", lambda *_: float)  # five seconds are the least that it takes
    with World(sandbox, overrides=["world.force_bias_n=[30,0,0]"]) as world:
        words = ["ft", "tare", "--seconds", 2, "--json", "--vehicle", VEHICLE, *world.addresses()]
        unasked = run_here(*words, "--sensor")
        zeroed = json.loads(run_here(*words, "--sensor", "--yes").out)
        cleared = json.loads(run_here(*words, "--clear", "--yes").out)
    assert unasked.code == EXIT_ABORTED
    assert "add --yes" in unasked.err
    assert [axis["axis"] for axis in zeroed["drift"]] == ["x", "y", "z"]
    assert zeroed["tare"]["bias_n"] == pytest.approx([30.0, 0.0, 0.0], abs=0.1), "watched before it was set: nobody had"
    assert [row["ok"] for row in zeroed["rows"] if row["id"] == "ft.bias_set"] == [True]
    assert cleared["tare"]["bias_n"] == pytest.approx([30.0, 0.0, 0.0], abs=0.1)


def test_no_sample_from_before_the_sensors_zero_was_set_or_cleared_is_used() -> None:
    async def go() -> list[float]:
        async with ForceTorqueServer() as server:
            server.set_wrench((3.0, 4.0, 0.0), (0.0, 0.0, 0.0))
            ticking = asyncio.ensure_future(_tick(server))
            try:
                async with RobotousForceTorque(ForceDevice(port=server.port), flight_clock()) as sensor:
                    read = []
                    for on in (True, False):
                        await sensor.set_bias(on)
                        read.append((await sensor.tare_samples(0.05))[0].force_sensor_n[0])
                    return read
            finally:
                ticking.cancel()
                await asyncio.wait((ticking,))

    assert asyncio.run(go()) == [0.0, 3.0]


async def _tick(server: ForceTorqueServer) -> None:
    loop = asyncio.get_running_loop()
    while True:
        server.tick(loop.time())
        await asyncio.sleep(0.002)
