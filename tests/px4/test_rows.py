"""The preflight's rows of firmware and parameters: what is wrong is named, with the fix; what is fine is not."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from companion.config.document import ConfigError
from companion.config.loader import load_vehicle
from companion.config.vehicle import Vehicle
from companion.flight.startup import changed_since
from companion.model.check_row import Level, Row
from companion.preflight.evaluation import param_names
from companion.preflight.px4 import firmware_row, rows
from companion.px4.defaults import PX4_DEFAULTS
from companion.px4.required import HOVER, ROTOR_COUNT, WANTED, file_values, simulated_values
from companion.px4.rotors import geometry_of
from companion.px4.versions import has
from companion.sitl_config.loader import load_world
from companion.sitl_config.world import World
from sitl.autopilot.backend import stub_of
from sitl.px4.parameters import parameters
from tests.io.stub_rig import standing_stub
from tests.io.test_px4 import edge
from tests.support import free_udp_port

VEHICLE_FILE = Path(__file__).parents[2] / "configs/vehicles/tarot650_2r.yaml"
FIRMWARE = "PX4 1.16.1 release (git 94cb20127)"
UDP = "vehicle.devices.autopilot.address=udpin://127.0.0.1:14540"

# Name, wrong value, whether the machine stays on the ground, and a part of the fix.
SPOILED = [
    ("EKF2_EV_CTRL", 0, True, "set EKF2_EV_CTRL to 11"),
    ("EKF2_HGT_REF", 1, True, "set EKF2_HGT_REF to 3 (companion px4 params --write), then reboot PX4"),
    ("EKF2_GPS_CTRL", 7, True, "set EKF2_GPS_CTRL to 0"),
    ("EKF2_MAG_TYPE", 0, True, "set EKF2_MAG_TYPE to 5"),
    ("EKF2_EV_DELAY", 100.0, True, "set EKF2_EV_DELAY to 5"),
    ("EKF2_EVP_NOISE", 0.5, False, "set EKF2_EVP_NOISE to 0.01"),
    ("EKF2_DELAY_MAX", 200.0, False, "set EKF2_DELAY_MAX to 50 (companion px4 params --write), then reboot PX4"),
    ("EKF2_TAU_VEL", 0.25, False, "set EKF2_TAU_VEL to 0.1"),
    ("SYS_HAS_MAG", 1, True, "then reboot PX4"),
    ("COM_OF_LOSS_T", 1.0, True, "set COM_OF_LOSS_T to 0.5"),
    ("COM_KILL_DISARM", 5.0, True, "set COM_KILL_DISARM to 0.5"),
    ("COM_OBL_RC_ACT", 0, True, "set COM_OBL_RC_ACT to 4"),
    ("NAV_DLL_ACT", 2, True, "set NAV_DLL_ACT to 0"),
    ("RTL_RETURN_ALT", 30.0, True, "set RTL_RETURN_ALT to 1.5"),
    ("COM_RC_IN_MODE", 7, True, "no_radio.params"),
    ("MPC_THR_HOVER", 0.2, True, "companion hover fit"),
    ("CA_ROTOR_COUNT", 6, True, "select the machine's airframe in QGroundControl"),
    ("BAT_CRIT_THR", 0.25, False, "set BAT_CRIT_THR to 0.1"),
    ("MC_BAT_SCALE_EN", 1, False, "set MC_BAT_SCALE_EN to 0"),
    ("MC_AIRMODE", 1, True, "set MC_AIRMODE to 0"),
]


def vehicle(*overrides: str) -> Vehicle:
    return load_vehicle(VEHICLE_FILE, [UDP, *overrides])


def good() -> dict[str, float | int]:
    return {**simulated_values(), HOVER: 0.49, ROTOR_COUNT: 4, "MC_YAW_P": 2.8, **geometry_of(vehicle().airframe)}


def wrong(params: dict[str, float | int], machine: Vehicle | None = None) -> list[Row]:
    return [row for row in rows(FIRMWARE, params, machine or vehicle()) if not row.ok]


def test_what_this_project_sets_is_fine() -> None:
    found = rows(FIRMWARE, good(), vehicle())
    assert wrong(good()) == []
    params = [f"px4.param.{wanted.name}" for wanted in WANTED if not wanted.hardware]
    assert [row.id for row in found[1:]] == [*params, "px4.rotors"]
    assert all(row.why and row.wanted for row in found)


@pytest.mark.parametrize(("name", "value", "refuses", "fix"), SPOILED)
def test_a_wrong_parameter_is_named_with_its_fix(name: str, value: float, refuses: bool, fix: str) -> None:
    (row,) = wrong({**good(), name: value})
    assert row.id == f"px4.param.{name}"
    assert row.title == name
    assert row.refuses is refuses
    assert row.read == f"{value:g}"
    assert fix in row.fix
    assert name in row.line()


def test_px4_as_it_comes_is_refused_for_what_matters() -> None:
    refused = {row.title for row in wrong({**PX4_DEFAULTS}) if row.refuses}
    assert refused >= {"EKF2_EV_CTRL", "EKF2_HGT_REF", "EKF2_GPS_CTRL", "EKF2_MAG_TYPE", "SYS_HAS_MAG", "COM_OF_LOSS_T"}
    assert refused >= {"COM_OBL_RC_ACT", "NAV_RCL_ACT", "RTL_RETURN_ALT"}


@pytest.mark.parametrize(
    ("name", "value"), [("COM_OF_LOSS_T", 0.2), ("COM_OF_LOSS_T", 0.20000000298023224), ("COM_RC_IN_MODE", 0)]
)
def test_the_ends_of_a_range_are_fine(name: str, value: float) -> None:
    assert wrong({**good(), name: value}) == []


def test_limits_follow_the_vehicle_file() -> None:
    low = vehicle("vehicle.room.z_m=[0.0, 1.6]")
    assert [row.title for row in wrong(good(), low)] == ["RTL_RETURN_ALT"]
    strong = vehicle("vehicle.airframe.thrust_max_n=120.0")
    assert [row.title for row in wrong(good(), strong)] == [HOVER]


def test_a_parameter_that_px4_does_not_have_is_reported() -> None:
    params = good()
    del params["EKF2_EV_QMIN"]
    (row,) = wrong(params)
    assert (row.title, row.read, row.level) == ("EKF2_EV_QMIN", "PX4 does not have this parameter", Level.WARN)


@pytest.mark.parametrize(
    "other", [("EKF2_GPS_DELAY",), ("SENS_GPS0_DELAY", "SENS_GPS1_DELAY")], ids=["has 1.18's", "has 1.16's"]
)
def test_a_parameter_of_another_version_is_not_missed(other: tuple[str, ...]) -> None:
    params = {name: value for name, value in good().items() if name not in other}
    assert len(params) < len(good())
    assert wrong(params) == []
    assert not {row.title for row in rows(FIRMWARE, params, vehicle())} & set(other)


def test_ekf2s_horizon_is_written_after_what_raises_it() -> None:
    order = list(file_values())
    raises = {"EKF2_EV_DELAY", "EKF2_ASP_DELAY", "EKF2_GPS_DELAY", "SENS_GPS0_DELAY", "SENS_GPS1_DELAY"}
    assert raises <= set(order[: order.index("EKF2_DELAY_MAX")])


def test_the_serial_port_counts_on_a_serial_link_only() -> None:
    serial = vehicle("vehicle.devices.autopilot.address=serial:///dev/ttyAMA0:921600")
    found = {row.title: row for row in wrong({**good(), "MAV_1_RATE": 0, "MAV_1_MODE": 2, "MAV_1_CONFIG": 102}, serial)}
    assert set(found) == {"MAV_1_RATE", "SER_TEL2_BAUD"}
    assert not any(row.refuses for row in found.values())
    assert wrong({**good(), "MAV_1_RATE": 0}) == []


@pytest.mark.parametrize(
    ("firmware", "ok", "refuses"),
    [
        ("PX4 1.16.0 release (git 0)", True, False),
        ("PX4 1.18.2 release (git 0)", True, False),
        ("PX4 1.18.0 beta (git 0)", False, False),
        ("PX4 1.17.0 release (git 0)", True, False),
        ("PX4 1.15.4 release (git 0)", True, False),
        ("PX4 1.14.3 release (git 0)", False, True),
        ("PX4 1.19.0 release (git 0)", False, False),
        ("PX4 2.0.0 release (git 0)", False, False),
        ("something", False, False),
    ],
)
def test_firmware(firmware: str, ok: bool, refuses: bool) -> None:
    row = firmware_row(firmware)
    assert (row.ok, row.refuses, row.read) == (ok, refuses, firmware)
    assert bool(row.fix) is not ok


def test_parameters_that_nobody_could_read_keep_the_machine_down() -> None:
    assert [row.id for row in rows(FIRMWARE, {}, vehicle()) if row.refuses] == ["px4.params"]
    assert rows(None, {}, vehicle()) == []


def test_a_parameter_that_changes_while_the_flight_waits_refuses_the_start_until_it_is_set_back() -> None:
    async def answers() -> list[str]:
        port = free_udp_port()
        said = []
        async with standing_stub(port), edge(port) as autopilot:
            checked = await autopilot.read_params(param_names(vehicle()))
            before = checked["COM_OBL_RC_ACT"]
            for value in (before, 6, before):
                await autopilot.write_param("COM_OBL_RC_ACT", value)
                said.append(await changed_since(checked, autopilot))
        return said

    first, changed, back = asyncio.run(answers())
    assert (first, back) == ("", "")
    assert "COM_OBL_RC_ACT is 6, was 4" in changed and changed.startswith("start refused: ")


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("{EKF2_EV_CTL: 1}", 'the simulated PX4 has no parameter "EKF2_EV_CTL" (did you mean EKF2_EV_CTRL?)'),
        ("{EKF2_EV_CTRL: 1.5}", "expected a whole number for EKF2_EV_CTRL, an INT32, got 1.5"),
        ("{EKF2_EVP_NOISE: 1.0e+39}", "EKF2_EVP_NOISE cannot hold 1e+39"),
    ],
)
def test_a_wrong_parameter_that_px4_cannot_have_is_refused(override: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_world([f"world.px4_params={override}"])
    assert said in caught.value.lines[0]


def test_a_parameter_that_only_a_real_px4_has_is_left_to_it() -> None:
    override = "world.px4_params={MC_REF_W_N: 100}"
    with pytest.raises(ConfigError, match=r"the simulated PX4 has no parameter \"MC_REF_W_N\".*--sitl=px4"):
        load_world([override])
    world, _ = load_world([override], real_px4=True)
    assert world.overridden_px4_params() == {"MC_REF_W_N": 100.0}
    with pytest.raises(ConfigError, match=r'expected a parameter name .* got "ekf2"'):
        load_world(["world.px4_params={ekf2: 1}"], real_px4=True)


@pytest.mark.parametrize(
    ("release", "absent"),
    [
        *(((1, minor), {"SENS_GPS0_DELAY", "SENS_GPS1_DELAY", "MC_REF_W_N"}) for minor in (15, 16, 17)),
        ((1, 18), {"COM_KILL_DISARM", "EKF2_GPS_DELAY", "SIM_BAT_ENABLE"}),
    ],
)
def test_each_version_has_its_own_parameters_and_none_of_another_is_missed(
    release: tuple[int, int], absent: set[str]
) -> None:
    """As read in the sources of 1.15.4, 1.16.1 and 1.17, and seen with 1.18."""
    simulated = parameters(vehicle().airframe, World(), 0.5)
    assert {name for name in {*file_values(), *simulated} if not has(name, release)} == absent
    assert wrong({name: value for name, value in good().items() if name not in absent}) == []


def test_1_18s_reference_model_as_it_comes_is_warned_of() -> None:
    (row,) = wrong({**good(), "MC_REF_W_N": 50.0})
    assert (row.title, row.level) == ("MC_REF_W_N", Level.WARN) and "set MC_REF_W_N to 200" in row.fix


def test_wrong_parameters_come_in_px4s_types() -> None:
    world = World(px4_params={"EKF2_EV_CTRL": 3.0, "COM_OF_LOSS_T": 1.0})
    assert world.overridden_px4_params() == {"EKF2_EV_CTRL": 3, "COM_OF_LOSS_T": 1.0}
    assert [type(value) for value in world.overridden_px4_params().values()] == [int, float]


def test_the_number_of_rotors_is_that_of_the_vehicle_file() -> None:
    hexacopter = load_vehicle("hexa_2r", [UDP])
    geometry = geometry_of(hexacopter.airframe)
    titles = {row.title for row in wrong({**good(), HOVER: 0.4}, hexacopter)}
    assert ROTOR_COUNT in titles
    assert wrong({**good(), HOVER: 0.4, ROTOR_COUNT: 6, **geometry}, hexacopter) == []
    served = stub_of(load_world()[0], hexacopter.airframe).params
    assert served[ROTOR_COUNT] == 6
    assert {name: served[name] for name in geometry} == pytest.approx(geometry)


PX4_QUAD_X = {
    f"CA_ROTOR{i}_{key}": value
    for i, row in enumerate(((0.15, 0.15, 0.05), (-0.15, -0.15, 0.05), (0.15, -0.15, -0.05), (-0.15, 0.15, -0.05)))
    for key, value in zip(("PX", "PY", "KM"), row, strict=True)
}
"""Generic quadrotor of PX4 (airframe 4001), whose rotor arm is not that of this vehicle."""


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({}, None),
        ({"CA_ROTOR0_PX": 0.20}, None),
        (
            {"CA_ROTOR0_PY": -0.15, "CA_ROTOR2_PY": 0.15},
            "CA_ROTOR0 is 45 deg to the left, ccw (vehicle file: 45 deg to the right, ccw); "
            "CA_ROTOR2 is 45 deg to the right, cw (vehicle file: 45 deg to the left, cw)",
        ),
        ({"CA_ROTOR3_KM": 0.05}, "CA_ROTOR3 is 135 deg to the right, ccw (vehicle file: 135 deg to the right, cw)"),
        ({"CA_ROTOR3_KM": 0.0}, "CA_ROTOR3 is 135 deg to the right, without yaw torque"),
        (dict.fromkeys((f"CA_ROTOR{i}_P{axis}" for i in range(4) for axis in "XY"), 0.0), "CA_ROTOR0 is at the centre"),
    ],
)
def test_another_motor_map_in_px4_is_refused(changed: dict[str, float], said: str | None) -> None:
    found = wrong({**good(), **PX4_QUAD_X, **changed})
    assert [row.id for row in found if row.refuses] == ([] if said is None else ["px4.rotors"])
    if said is not None:
        assert said in found[0].read and "select the machine's airframe" in found[0].fix


def test_a_px4_without_the_rotors_parameters_only_warns() -> None:
    (row,) = wrong({name: value for name, value in good().items() if name != "CA_ROTOR2_PY"})
    assert (row.id, row.refuses) == ("px4.rotors", False)
