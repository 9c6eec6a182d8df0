"""Worlds as files: numbers that are drawn by the seed, and the lines that tell what is wrong with a file."""

# ruff: noqa: E501  (the lines are as long as users see them)

from __future__ import annotations

import json
import math
import statistics
from pathlib import Path

import jsonschema
import pytest

from companion.cli.schema import schema_json
from companion.config.document import ConfigError
from companion.config.yaml_strict import read_document
from companion.model.constants import GRAVITY_M_S2
from companion.sitl_config.distributions import Normal, Range, Uniform, with_model_error
from companion.sitl_config.effects.machine import Machine
from companion.sitl_config.loader import WORLDS, SitlConfig, load_sitl, load_world
from companion.sitl_config.per_joint import of_joints
from companion.sitl_config.world import World
from sitl.campaigns.flights import with_world
from sitl.fast.loop import FastFlight
from sitl.server import Sitl
from sitl.wires import MachineWires, Ports
from sitl.world.effects.machine import true_chain
from sitl.world.model import base_mass_kg
from sitl.world.start import start_of
from tests.support import HOVER, tool_of

FILE = """\
hover_thrust_error: {uniform: [-0.1, 0.1]}
rotor_lag_s: {normal: [0.04, 0.005]}
force_bias_n: [{uniform: [1, 2]}, {uniform: [1, 2]}, 3.0]
faults:
  - {kind: force_loss, t_s: {uniform: [0, 40]}}
px4_params: {MC_ROLLRATE_P: {uniform: [0.1, 0.2]}}
"""


@pytest.fixture
def file(tmp_path: Path) -> str:
    path = tmp_path / "mine.yaml"
    path.write_text(FILE)
    return str(path)


def test_every_built_in_world_can_be_drawn_by_any_seed() -> None:
    for name in WORLDS:
        for seed in range(5):
            world, laboratory = load_world([f"world.seed={seed}"], name)
            assert (world.seed, laboratory.name) == (seed, name)


def test_a_world_has_the_values_of_the_world_that_it_extends(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("extends: lab\npayload_kg: 0.1\nforce_noise_n: -1.0\nmass_error: {uniform: [0.1, 0.2]}")
    with pytest.raises(ConfigError) as refused:
        load_world([], str(path))
    assert [line.split(" expected")[0] for line in refused.value.lines] == [f"{path}:3:16: force_noise_n:"]
    world, laboratory = load_world(["world.force_noise_n=0.1"], str(path))
    lab, lab_ranges = load_world([], "lab")
    own = {"extends", "payload_kg", "force_noise_n", "mass_error"}
    assert world.model_dump(exclude=own) == lab.model_dump(exclude=own)
    assert (world.payload_kg, world.force_noise_n) == (0.1, 0.1)
    assert 0.1 <= world.mass_error <= 0.2
    assert {one.key for one in laboratory.ranges} == {one.key for one in lab_ranges.ranges}
    path.write_text("extends: lob")
    with pytest.raises(ConfigError, match=r"1:10: extends: .*did you mean lab"):
        load_world([], str(path))


def test_each_number_is_drawn_by_the_seed_and_its_own_name(file: str) -> None:
    world, laboratory = load_world(["world.seed=3"], file)
    assert load_world(["world.seed=3"], file) == (world, laboratory)
    other, _ = load_world(["world.seed=4"], file)
    drawn, otherwise = laboratory.drawn(world), laboratory.drawn(other)
    assert list(drawn) == [
        *("hover_thrust_error", "rotor_lag_s", "force_bias_n[0]", "force_bias_n[1]"),
        *("faults[0].t_s", "px4_params.MC_ROLLRATE_P"),
    ]
    assert all(drawn[key] != otherwise[key] for key in drawn)
    assert drawn["force_bias_n[0]"] != drawn["force_bias_n[1]"], "same range, different keys"
    assert world.force_bias_n[2] == 3.0
    fewer, _ = load_world(["world.seed=3", "world.rotor_lag_s=0.05", "world.faults=[]"], file)
    assert fewer.rotor_lag_s == 0.05
    assert (fewer.hover_thrust_error, fewer.force_bias_n) == (world.hover_thrust_error, world.force_bias_n)


def test_an_override_may_be_a_distribution() -> None:
    found = {
        load_world(["world.rotor_lag_s={uniform: [0.02, 0.03]}", f"world.seed={n}"])[0].rotor_lag_s for n in range(9)
    }
    assert len(found) == 9
    assert 0.02 <= min(found) < max(found) <= 0.03


def test_samples_have_the_distribution_of_the_file() -> None:
    uniform = Range(at=("a",), distribution=Uniform(uniform=(2.0, 4.0)))
    normal = Range(at=("a",), distribution=Normal(normal=(1.0, 0.5)))
    flat, bell = [[one.sample(seed) for seed in range(2000)] for one in (uniform, normal)]
    assert 2.0 <= min(flat) < 2.01 and 3.99 < max(flat) <= 4.0
    assert statistics.fmean(flat) == pytest.approx(3.0, abs=4 * 2 / math.sqrt(12 * 2000))
    assert statistics.fmean(bell) == pytest.approx(1.0, abs=4 * 0.5 / math.sqrt(2000))
    assert statistics.stdev(bell) == pytest.approx(0.493, abs=0.03)
    assert min(bell) >= -0.5 and max(bell) <= 2.5, "truncated at 3 sigma"


def test_another_seed_draws_the_laboratory_anew_but_keeps_what_was_set(file: str) -> None:
    config = load_sitl(HOVER, overrides=["world.rotor_lag_s=0.05"], world=file)
    travelled = SitlConfig.model_validate_json(config.model_dump_json())
    assert travelled == config
    other = with_world(travelled, {"seed": 9, "payload_kg": 0.1})
    expected, _ = load_world(["world.rotor_lag_s=0.05", "world.seed=9", "world.payload_kg=0.1"], file)
    assert other.world == expected
    assert with_world(other, {"seed": 1, "payload_kg": 0.2}) == config
    assert with_world(config, {"seed": 9, "hover_thrust_error": 0.02}).world.hover_thrust_error == 0.02


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("rotor_lag_s: {uniform: [2, 1]}", "1:14: rotor_lag_s: uniform: expected [low, high] with low < high, got [2, 1]"),
        ("rotor_lag_s: {normal: [1, 0]}", "1:14: rotor_lag_s: normal: expected [mean, sigma] with sigma > 0, got [1, 0]"),
        (
            "rotor_lag_s: {poisson: [1, 2]}",
            "1:14: rotor_lag_s: unknown distribution \"poisson\"; "
            "expected a number, {uniform: [low, high]}, {log_uniform: [low, high]} or {normal: [mean, sigma]}",
        ),
        ("rotor_lag_s: {uniform: [-0.1, 0.1]}", "1:14: rotor_lag_s: expected a number > 0, got -0.1 at the lower end of the drawn range"),
        ("mass_error: {uniform: [0, 0.6]}", "1:13: mass_error: expected a number from -0.5 to 0.5, got 0.6 at the upper end of the drawn range"),
        ("throws: {uniform: [1, 5]}", "1:9: throws: expected a whole number from 1 to 1000, got a mapping"),
        ("handling: {uniform: [0, 1]}", "1:11: handling: expected true or false, got a mapping"),
    ],
)  # fmt: skip
def test_a_mistake_is_reported_once_with_its_place_whatever_the_seed(tmp_path: Path, text: str, line: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    for seed in (1, 2):
        with pytest.raises(ConfigError) as refused:
            load_world([f"world.seed={seed}"], str(path))
        assert refused.value.lines == (f"{path}:{line}",)


def test_a_world_that_does_not_exist_is_refused_with_those_that_do() -> None:
    with pytest.raises(
        ConfigError,
        match=r"--world labb: expected careless, ideal, lab.* or a file, found neither \(did you mean lab\?\)",
    ):
        load_world([], "labb")
    with pytest.raises(ConfigError, match=r"mine\.yaml: no such file"):
        load_world([], "mine.yaml")


def test_the_schema_knows_distributions(file: str) -> None:
    schema = jsonschema.Draft202012Validator(json.loads(schema_json("world")))
    schema.validate(read_document(file).data)
    for wrong in ({"rotor_lag_s": {"unifrom": [1, 2]}}, {"throws": {"uniform": [1, 2]}}):
        with pytest.raises(jsonschema.ValidationError):
            schema.validate(wrong)


def test_each_joint_of_a_longer_arm_draws_its_own_number_from_the_last_distribution_of_a_list() -> None:
    two, _ = load_world(["world.seed=3"], "lab", 2)
    five, laboratory = load_world(["world.seed=3"], "lab", 5)
    for of_two, of_five in zip(_per_joint(two), _per_joint(five), strict=True):
        assert of_five[:2] == of_two, "the numbers of two joints do not depend on further joints"
        assert len(set(of_five)) == 5
    assert laboratory.drawn(five)["link_mass_error[4]"] == five.link_mass_error[4]
    assert load_world(["world.seed=3"], "lab", 1)[0] == two, "surplus values of a file stay"


def test_a_list_with_one_value_for_each_joint_holds_for_any_number_of_joints() -> None:
    assert of_joints((0.1, 0.2), 4) == (0.1, 0.2, 0.2, 0.2)
    assert of_joints((0.1, 0.2), 1) == (0.1,)
    assert of_joints((0.1, 0.2), 0) == ()
    world = World.model_validate({"servos": [{"id": 7}], "model_error": 0.2})
    assert [world.servo(joint).id for joint in range(3)] == [7, None, None]
    off = with_model_error(world, 3)
    errors = (*off.link_mass_error, *(off.servo(joint).torque_per_amp_error for joint in range(3)))
    assert {abs(round(error, 9)) for error in errors} == {0.2} and len(errors) == 6
    assert with_model_error(world, 0).link_mass_error == ()


def _per_joint(world: World) -> tuple[tuple[float, ...], ...]:
    machine, mechanics = world.machine, world.servo_mechanics
    return (
        world.link_mass_error,
        machine.link_length_error_m,
        machine.link_com_error_m,
        mechanics.torque_per_amp_error,
    )


# -- the model error ---------------------------------------------------------------------------------------------------


def test_a_model_error_multiplies_what_the_laboratory_errs_by_already() -> None:
    machine = {"on": True, "inertia_error": (0.1, -0.1, 0.0)}
    usual = World.model_validate({"mass_error": 0.03, "link_mass_error": (0.05, -0.05), "machine": machine})
    factors = set()
    for seed in range(20):
        off = with_model_error(usual.model_copy(update={"seed": seed, "model_error": 0.2}), 2)
        assert off == with_model_error(usual.model_copy(update={"seed": seed, "model_error": 0.2}), 2)
        before = (0.03, 0.05, -0.05, 0.1, -0.1, 0.0, 0.0, 0.0)
        torque = [off.servo(joint).torque_per_amp_error for joint in range(2)]
        after = (off.mass_error, *off.link_mass_error, *off.machine.inertia_error, *torque)
        factor = [round((1.0 + now) / (1.0 + then), 9) for then, now in zip(before, after, strict=True)]
        assert set(factor) <= {0.8, 1.2}
        assert len(set(factor[3:6])) == 1, "a body's moments stay possible"
        factors.add(tuple(factor))
    assert len(factors) > 10, "signs are drawn one by one"
    assert with_model_error(usual, 2) is usual


def test_a_model_error_without_the_section_machine_changes_nothing_else_of_the_machine() -> None:
    off = with_model_error(World(model_error=0.3), 2).machine
    assert {abs(round(error, 9)) for error in off.inertia_error} == {0.3}
    assert off.model_copy(update={"inertia_error": (0.0, 0.0, 0.0)}) == Machine(
        on=True,
        inertia_error=(0.0, 0.0, 0.0),
        centre_of_mass_m=(0.0, 0.0, 0.0),
        shoulder_offset_m=(0.0, 0.0, 0.0),
        shoulder_rpy_deg=(0.0, 0.0, 0.0),
        link_length_error_m=(0.0, 0.0),
        link_com_error_m=(0.0, 0.0),
    )


def test_both_loops_fly_the_machine_with_the_model_error() -> None:
    config = load_sitl(HOVER, overrides=["world.model_error=0.2"])
    true, believed = (FastFlight(c).plant.machine.weight_n for c in (config, load_sitl(HOVER)))
    start = start_of((0.0, 0.0), 0.0, (90.0, 90.0))
    wires = MachineWires(config.vehicle, config.world, start, Ports(), lambda message: None)
    plant = Sitl([wires]).machines[0].plant
    assert plant.machine.weight_n == true
    tool, errs = tool_of(config.vehicle), with_model_error(config.world, 2)
    links_kg = [link.mass_kg for link in true_chain(config.vehicle, errs).links]
    true_kg = base_mass_kg(config.vehicle, errs) + sum(links_kg) + tool.sensor_mass_kg + tool.beyond_sensor_kg
    assert true == pytest.approx(GRAVITY_M_S2 * true_kg, rel=1e-6)
    assert true != pytest.approx(believed, rel=0.05)


def test_each_rotor_of_an_octocopter_is_drawn_and_those_of_a_quadrotor_stay_as_they_were() -> None:
    plain, _ = load_world(["world.seed=3"], "lab")
    four, _ = load_world(["world.seed=3"], "lab", rotors=4)
    eight, _ = load_world(["world.seed=3"], "lab", rotors=8)
    assert four == plain
    assert eight.rotors.thrust_error[:4] == four.rotors.thrust_error
    assert len(set(eight.rotors.thrust_error)) == len(set(eight.rotors.yaw_torque_error)) == 8
    assert eight.model_copy(update={"rotors": four.rotors}) == four
