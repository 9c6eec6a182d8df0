"""Policies as laws: the trained one flies, its log can be replayed, and one that cannot fly is refused before the flight."""

from __future__ import annotations

import hashlib
import importlib
import itertools
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from companion.cli.main import _normalised, main, make_parser
from companion.config.loader import load_flight, logged_flight
from companion.config.policy import PolicyCard
from companion.control.policy import Network
from companion.core.flight_core import FlightCore
from companion.sitl_config.loader import load_sitl
from sitl.fast.loop import FastFlight
from sitl.gym.environment import FlightEnvironment
from sitl.gym.export import mark, write_policy
from tests.support import HOVER, ROOT, SHORT_CATCH

pytestmark = pytest.mark.usefixtures("short_start")

STEPS, TICKS = 30, 600


@pytest.fixture(scope="module")
def environment() -> FlightEnvironment:
    made = gymnasium.make("companion/Hover-v0").unwrapped
    assert isinstance(made, FlightEnvironment)
    return made


def written(path: Path, card: PolicyCard, gain: float = 0.3) -> Path:
    """A policy with random weights and scales."""
    generator, inputs = np.random.default_rng(7), len(card.observations)
    scales = tuple(generator.uniform(0.5, 3.0, inputs).tolist())
    layers = [(gain * generator.standard_normal((inputs, 8)), np.zeros(8)), (gain * np.ones((8, 5)), np.full(5, 0.1))]
    write_policy(layers, card.model_copy(update={"observation_scale": scales}), path)
    return path


def test_a_policy_commands_the_same_in_training_flight_and_replay(
    environment: FlightEnvironment, tmp_path: Path
) -> None:
    path = written(tmp_path / "mine.onnx", environment.card)
    observation, _ = environment.reset(options={"laboratory": 5})
    network = Network(str(path))
    for _ in range(STEPS):
        observation, *_ = environment.step(np.array(network.decide(observation.tolist()), np.float32))
    trained = environment._result.outputs
    config = load_sitl("hover", controller_law=str(path), world="lab", overrides=["world.seed=5"])
    ticks = itertools.count(1)
    flown = FastFlight(config).run(until=lambda _: next(ticks) == len(trained))
    assert [o.arm_torque_nm for o in flown.outputs] == [o.arm_torque_nm for o in trained]
    assert [o.attitude for o in flown.outputs] == [o.attitude for o in trained]
    base = FastFlight(load_sitl("hover", world="lab", overrides=["world.seed=5"])).run(
        until=lambda o: o.t_s > trained[-1].t_s
    )
    assert [o.attitude for o in base.outputs][: len(trained)] != [o.attitude for o in trained]

    logged = FastFlight(config).config.flight.model_dump_json()
    core = FlightCore(logged_flight(logged))
    assert [core.step(i) for i in flown.inputs] == flown.outputs
    written(path, environment.card, gain=0.31)
    with pytest.raises(ValueError, match=r"mine\.onnx: is not the file that flew: its SHA-256 is "):
        FlightCore(logged_flight(logged))


def test_the_example_writes_the_network_that_it_trained(
    environment: FlightEnvironment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "examples/policy"))
    train = importlib.import_module("train")
    names = environment.card.observations
    generator = np.random.default_rng(3)
    layer, scales = train.layer(generator.standard_normal(train.PARAMETERS), names, 5), np.array(train.scales(names))
    card = environment.card.model_copy(update={"observation_scale": tuple(scales.tolist())})
    write_policy([layer], card, tmp_path / "mine.onnx")
    observation = generator.standard_normal(len(names))
    action = Network(str(tmp_path / "mine.onnx")).decide(observation.tolist())
    np.testing.assert_allclose(action, np.tanh(observation / scales @ layer[0]), atol=1e-5)
    assert min(map(abs, action[:3])) > 0.0
    assert action[3:] == [0.0, 0.0]


def test_the_notebook_trains_and_its_commands_are_those_of_the_companion(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One generation of two candidates; the flights after it are for who runs the notebook."""
    plt = pytest.importorskip("matplotlib.pyplot")
    plt.switch_backend("agg")
    text = (ROOT / "examples/policy/policy.ipynb").read_text(encoding="utf-8")
    cells = {cell["id"]: cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"}
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in cells.values())
    monkeypatch.syspath_prepend(str(ROOT / "examples/policy"))
    monkeypatch.chdir(tmp_path)
    train = importlib.import_module("train")
    for name, small in {"POPULATION": 2, "FLIGHTS": 1, "MISSION": str(SHORT_CATCH)}.items():
        monkeypatch.setattr(train, name, small)
    names: dict[str, Any] = {}
    exec("".join(cells["settings"]["source"]), names)
    names["MINUTES"] = 0
    exec("".join(cells["train"]["source"]), names)
    (generation,) = names["generations"]
    assert 0.0 < generation.best <= generation.median < 2.0
    assert [line.get_ydata().tolist() for line in names["axes"].lines] == [
        [generation.base],
        [generation.median],
        [generation.best],
    ]
    plt.close(names["figure"])
    commands = re.findall(r'companion\(f\\"(.*?)\\"', text)
    assert [command.split()[0] for command in commands] == ["fly", "compare", "robustness", "faults"]
    for command in commands:
        words = re.sub(r"{\S*}", "1", command.replace("{law} ", "")).split()
        assert make_parser().parse_known_args(_normalised(words))[1] == []
    Network(str(tmp_path / "policy.onnx"))


def test_a_mission_finds_the_file_of_its_policy_beside_itself(environment: FlightEnvironment, tmp_path: Path) -> None:
    path = written(tmp_path / "mine.onnx", environment.card)
    text = HOVER.read_text(encoding="utf-8").replace("../", f"{HOVER.parents[1]}/")
    mission = tmp_path / "mission.yaml"
    mission.write_text(
        text.replace("law: adaptive, preset: recommended", "law: policy, file: mine.onnx"), encoding="utf-8"
    )
    found = load_flight(mission).controller.model_dump()
    assert (found["law"], found["preset"]) == ("policy", "mine")
    assert found["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    mission.write_text(
        text.replace("preset: recommended", "").replace("law: adaptive", "law: policy"), encoding="utf-8"
    )
    assert main(["check", str(mission), "--plan-only"]) == 2


def not_a_number(path: Path, card: PolicyCard) -> None:
    written(path, card, gain=float("nan"))


def slow(path: Path, card: PolicyCard) -> None:
    """The square of a matrix of 1000 x 1000 before every action."""
    nodes = [
        helper.make_node("ReduceSum", ["observation", "axes"], ["sum"], keepdims=0),
        helper.make_node("Expand", ["sum", "square"], ["matrix"]),
        helper.make_node("MatMul", ["matrix", "matrix"], ["product"]),
        helper.make_node("Slice", ["product", "zeros", "ends"], ["corner"]),
        helper.make_node("Tanh", ["corner"], ["action"]),
    ]
    numbers = {"axes": [0, 1], "square": [1000, 1000], "zeros": [0, 0], "ends": [1, 5]}
    constants = [helper.make_tensor(name, TensorProto.INT64, [2], value) for name, value in numbers.items()]
    shapes = {"observation": [1, len(card.observations)], "action": [1, 5]}
    ports = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in shapes.items()]
    graph = helper.make_graph(nodes, "slow", ports[:1], ports[1:], constants)
    mark(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), card, path)


def stochastic(path: Path, card: PolicyCard) -> None:
    """A policy that was exported with the sampling of its training."""
    written(path, card)
    model = onnx.load(path)
    model.graph.node[-1].output[0] = "mean"
    model.graph.node.append(helper.make_node("RandomNormalLike", ["mean"], ["noise"], scale=0.01))
    model.graph.node.append(helper.make_node("Add", ["mean", "noise"], ["action"]))
    onnx.save(model, path)


def of_another_size(path: Path, card: PolicyCard) -> None:
    more = {
        "observations": (*card.observations, "wind"),
        "observation_offset": (0.0,) * 33,
        "observation_scale": (1.0,) * 33,
    }
    written(path, PolicyCard.model_validate(card.model_dump() | more))


def without_a_card(path: Path, card: PolicyCard) -> None:
    written(path, card)
    model = onnx.load(path)
    del model.metadata_props[:]
    onnx.save(model, path)


REFUSED: dict[str, tuple[Callable[[Path, PolicyCard], object], str]] = {
    "not a number": (not_a_number, "returns [nan, nan, nan, nan, nan], which is not finite"),
    "stochastic": (stochastic, "returns different actions for the same observation; export its mean"),
    "slow": (slow, " ms for an action (limit 2.5 ms, half a tick)"),
    "unknown observation": (of_another_size, "its observations are not those of this companion and vehicle: wind"),
    "text": (lambda path, card: path.write_text("hello"), "expected a policy in an ONNX file, found none: "),
    "no card": (without_a_card, "its metadata have no key 'companion'"),
    "absent": (lambda path, card: None, "cannot be read: No such file or directory"),
    "another vehicle": (
        lambda path, card: written(path, card.model_copy(update={"mass_kg": 9.0})),
        "was trained for the vehicle 'tarot650-2r' of 9 kg, but this one is 'tarot650-2r' of ",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_policy_that_cannot_fly_is_refused_in_one_line(
    environment: FlightEnvironment, tmp_path: Path, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    write, reason = REFUSED[case]
    path = tmp_path / "bad.onnx"
    write(path, environment.card)
    assert main(["check", "hover", "--plan-only", "--controller", str(path)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"{path}: ")
    assert err.count("\n") == 1
    assert reason in err


def test_the_law_without_a_file_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "hover", "--plan-only", "--controller", "policy"]) == 2
    assert main(["compare", "--controllers", "policy"]) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert first == "control law 'policy' has no presets: name its file in place of the law, such as policy.onnx"
    assert second == "companion compare: --controllers policy: has no presets; name its file, such as policy.onnx"
