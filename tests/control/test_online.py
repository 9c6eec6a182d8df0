"""The optimisation of the target impedance in flight: bounded, within both conditions, frozen if disturbed, undone, replayed."""

from __future__ import annotations

import copy
import math
from pathlib import Path

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings
from msgspec.structs import replace

from companion.analysis.proposal import write_proposal
from companion.config.controller import AdaptiveConfig, OnlineConfig
from companion.config.loader import load_flight
from companion.control.adaptive import AdaptiveController
from companion.control.online import TANK_MAX_J, OnlineImpedance
from companion.control.types import Tuning
from companion.core.flight_core import FlightCore
from companion.model.outputs import Outputs
from companion.model.types import Chi, OperatorCommand, PhaseKind, SafetyAction, Vec3
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.campaigns.flights import log_of
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult

pytestmark = pytest.mark.usefixtures("short_start")


CONFIG = load_flight("configs/missions/circuit.yaml", preset="recommended")
assert isinstance(CONFIG.controller, AdaptiveConfig)
LAW = AdaptiveConfig.model_validate(CONFIG.controller.model_dump() | {"online": {"bound": 1.4}})
DT_S = 0.005
ZERO: Vec3 = (0.0, 0.0, 0.0)


def online(keep: bool = False) -> OnlineImpedance:
    return OnlineImpedance(OnlineConfig(bound=1.4, keep=keep), LAW.inertia_md[:3], LAW.lambda_gain[:3], LAW.phi[:3])


def row(value: float) -> Chi:
    return (value, -value, 0.5 * value, 0.0, 0.0, 0.0, 0.0, 0.0)


def moved(it: OnlineImpedance, seconds: float, error_m: float = 0.05, tuning: Tuning = Tuning.RUN) -> float:
    """The scale after some seconds with a slow error, and some damping that fills the tank."""
    for _ in range(round(seconds / DT_S)):
        it.step(DT_S, row(error_m), row(0.1), ZERO, ZERO, False, tuning)
    return it.scale


size = st.one_of(st.floats(-2.0, 2.0), st.sampled_from([0.0, 1e3, math.inf, math.nan]))
ticks = st.tuples(
    st.integers(1, 300),
    st.sampled_from([0.001, 0.005, 0.05]),
    size,
    size,
    size,
    size,
    st.booleans(),
    st.sampled_from(Tuning),
)


@settings(max_examples=25, deadline=None)
@given(st.lists(ticks, max_size=12))
def test_whatever_happens_bound_tank_and_both_conditions_hold_at_every_tick(
    inputs: list[tuple[int, float, float, float, float, float, bool, Tuning]],
) -> None:
    law = AdaptiveController(LAW, CONFIG.vehicle, 0.5)
    it = law.online
    assert it is not None
    for count, dt_s, e, v, rate, force, clipped, tuning in inputs:
        for _ in range(count):
            before = it.scale
            if it.step(dt_s, row(e), row(v), (rate, rate, 0.0), (0.0, 0.0, force), clipped, tuning):
                law.scale_gains(it.scale)
            assert 1.0 / 1.4 - 1e-12 <= it.scale <= 1.4 + 1e-12
            assert 0.0 <= it.tank_j <= TANK_MAX_J
            assert not (clipped and tuning is Tuning.RUN and it.scale > before)
            for base_row in law._rows[:3]:
                m_d, phi, d = base_row.M_d, base_row.Phi, base_row.D
                k_d, k_p = d + m_d * phi, d * phi
                assert k_d / m_d > phi  # gain_new
                assert k_p == pytest.approx((k_d - m_d * phi) * phi, rel=1e-9)  # gain_cond
    LAW.with_impedance_scale(it.scale)  # the conditions as the controller file checks them


def test_it_stiffens_for_a_slow_error_at_a_bounded_rate_and_only_with_energy_in_the_tank() -> None:
    it = online()
    assert 1.0 < moved(it, 5.0) <= math.exp(0.03 * 5.0)
    empty = online()
    for _ in range(2000):
        empty.step(DT_S, row(0.05), row(0.0), ZERO, ZERO, False, Tuning.RUN)
    assert empty.scale == 1.0


def test_it_softens_fast_while_the_vehicle_shakes_saturated_or_not() -> None:
    it = online()
    for k in range(1000):
        rate = 1.5 * math.sin(7.0 * k * DT_S)
        it.step(DT_S, row(0.03), row(0.2), (rate, 0.0, 0.0), ZERO, k % 50 < 25, Tuning.RUN)
    assert it.scale == pytest.approx(1.0 / 1.4)


def test_no_error_however_large_stiffens_a_vehicle_that_shakes() -> None:
    it = online()
    for k in range(800):
        it.step(DT_S, row(2.0), row(0.5), (2.0 * math.sin(7.0 * k * DT_S), 0.0, 0.0), ZERO, False, Tuning.RUN)
        assert it.scale <= 1.0
    assert it.scale < 1.0


def test_a_blow_missing_ticks_and_a_disturbed_flight_freeze_it() -> None:
    it = online()
    scale = moved(it, 5.0)
    assert moved(it, 5.0, tuning=Tuning.FREEZE) == scale
    it.step(DT_S, row(0.05), row(0.1), ZERO, (0.0, 0.0, -5.0), False, Tuning.RUN)
    assert moved(it, 1.5) == scale  # the quiet time, then a new window
    it.step(0.03, row(0.05), row(0.1), ZERO, ZERO, False, Tuning.RUN)
    assert moved(it, 1.5) == scale
    assert moved(it, 5.0) > scale


def test_it_is_undone_unless_the_operator_keeps_it() -> None:
    undone, kept = online(), online(keep=True)
    assert moved(undone, 8.0) == moved(kept, 8.0) > 1.1
    undone.take_report()
    assert moved(undone, 2.0, tuning=Tuning.UNDO) == 1.0
    assert "undone" in (undone.take_report() or "")
    assert moved(kept, 2.0, tuning=Tuning.UNDO) > 1.1


@pytest.fixture(scope="module")
def soft() -> tuple[SitlConfig, FastResult]:
    """A flight from gains that are too soft, in a laboratory."""
    sets = ["world.seed=7001", "world.payload_kg=0", "controller.online={}"]
    config = load_sitl("configs/missions/circuit.yaml", preset="recommended", overrides=sets, world="lab")
    assert isinstance(config.controller, AdaptiveConfig)
    flight = FastFlight(config.model_copy(update={"controller": config.controller.with_impedance_scale(0.5)}))
    return flight.config, flight.run()


def scales(outputs: list[Outputs]) -> list[float]:
    return [
        o.control.impedance_scale for o in outputs if o.control is not None and o.control.impedance_scale is not None
    ]


def test_a_flight_reports_the_changes_undoes_them_and_proposes_them(
    soft: tuple[SitlConfig, FastResult], tmp_path: Path
) -> None:
    config, result = soft
    flown = [o for o in result.outputs if o.phase_kind is PhaseKind.FLIGHT]
    best = scales(flown)[-1]
    assert 1.15 < best <= 2.0
    assert scales(result.outputs)[-1] == 1.0
    texts = [event.text for o in result.outputs for event in o.events if event.id == "impedance_scaled"]
    assert len(texts) >= 3
    assert "undone" in texts[-1]
    file = tmp_path / "controller.yaml"
    write_proposal(log_of(config.flight, result, None), file)
    proposed = load_flight("configs/missions/circuit.yaml", controller_law=str(file)).controller
    assert isinstance(proposed, AdaptiveConfig)
    assert isinstance(config.controller, AdaptiveConfig)
    assert proposed.phi[0] == pytest.approx(best * config.controller.phi[0], rel=1e-5)


def test_it_replays_and_a_hold_or_a_stale_pose_freezes_the_scale(soft: tuple[SitlConfig, FastResult]) -> None:
    config, result = soft
    begin = next(k for k, o in enumerate(result.outputs) if o.control and (o.control.impedance_scale or 1.0) > 1.1)
    core = FlightCore(config.flight)
    for i, o in zip(result.inputs[:begin], result.outputs, strict=False):
        assert core.step(i) == o
    for cause in ({"command": OperatorCommand.HOLD}, {"mocap": result.inputs[begin].mocap}):
        disturbed = copy.deepcopy(core)
        after = [disturbed.step(replace(i, **cause)) for i in result.inputs[begin : begin + 100]]
        assert after[-1].action is not SafetyAction.NOMINAL or "mocap" in cause
        assert len(set(scales(after)[30:])) == 1
    assert len(set(scales(result.outputs[begin : begin + 100])[30:])) > 1
