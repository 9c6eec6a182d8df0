"""The grid of a comparison, and the means of its rows."""

from __future__ import annotations

import io
import re
from typing import Any

import pytest
from rich.console import Console

from companion.campaigns.compare.aggregate import Pairs, Spread, adaptation_pairs, aggregate, pairs_with_reference
from companion.campaigns.compare.grid import ABLATED, ABLATIONS, flights_of, variants_of
from companion.campaigns.compare.tables import compliance_table, difference_text, print_tables
from companion.campaigns.runner import Row
from companion.sitl_config.loader import load_sitl
from tests.campaigns.made_up import compare_row
from tests.support import CATCH

AVAILABLE = {"adaptive": ("paper", "recommended"), "csc": ("tuned",), "psc": ("tuned",)}


def row(seed: int, e_p_m: float | None, **changes: Any) -> Row:
    """A made-up flight of adaptive/paper with 0.2 kg; e_p_m None: it crashed after the catch."""
    flight = {"controller": "adaptive", "preset": "paper", "payload_kg": 0.2, "seed": seed}
    return compare_row(flight, e_p_m, **changes)


# -- the grid ----------------------------------------------------------------------------------------------------------


def labels(
    controllers: tuple[str, ...] = (),
    presets: tuple[str, ...] = (),
    ablation: bool = False,
    adaptation: tuple[str, ...] = ("on",),
) -> list[str]:
    return [variant.label for variant in variants_of(AVAILABLE, controllers, presets, ablation, adaptation)]


def test_all_laws_fly_all_their_presets_unless_asked_otherwise() -> None:
    assert labels() == ["adaptive/paper", "adaptive/recommended", "csc/tuned", "psc/tuned"]
    assert labels(controllers=("psc", "adaptive")) == ["psc/tuned", "adaptive/paper", "adaptive/recommended"]


def test_presets_are_chosen_where_a_law_has_them() -> None:
    assert labels(presets=("recommended",)) == ["adaptive/recommended", "csc/tuned", "psc/tuned"]
    assert labels(presets=("tuned",)) == ["adaptive/paper", "adaptive/recommended", "csc/tuned", "psc/tuned"]


def test_ablations_follow_the_preset_that_they_change() -> None:
    found = labels(ablation=True)
    at = found.index("/".join(ABLATED))
    assert found[at + 1 : at + 1 + len(ABLATIONS)] == [f"{'/'.join(ABLATED)} - {what}" for what in ABLATIONS]
    assert "adaptive/recommended" in labels(presets=("paper",), ablation=True), "nothing to see it beside"


def test_the_adaptation_can_be_switched_off_in_every_preset_of_the_adaptive_law() -> None:
    both = ["adaptive/paper", "adaptive/paper - adaptation off", "csc/tuned", "psc/tuned"]
    assert labels(presets=("paper",), adaptation=("on", "off")) == both
    assert labels(presets=("paper",), adaptation=("off",)) == both[1:]
    ablated = labels(controllers=("adaptive",), presets=("recommended",), ablation=True, adaptation=("off",))
    assert ablated == labels(controllers=("adaptive",), presets=("recommended",), ablation=True)


def test_every_ablation_changes_the_configuration_and_is_accepted() -> None:
    law, preset = ABLATED
    whole = load_sitl(CATCH, None, law, preset).controller
    seen = [load_sitl(CATCH, None, law, preset, overrides).controller for overrides in ABLATIONS.values()]
    for what, less in zip(ABLATIONS, seen, strict=True):
        assert less != whole, what
    assert len({less.model_dump_json() for less in seen}) == len(seen)


def test_the_grid_is_in_the_order_of_the_table() -> None:
    variants = variants_of(AVAILABLE, ("adaptive",), (), False)
    flights = flights_of(variants, (0.3, 0.1), (1, 2))
    assert [(f["payload_kg"], f["variant"], f["seed"]) for f in flights] == [
        (payload, variant, seed) for payload in (0.3, 0.1) for variant in (0, 1) for seed in (1, 2)
    ]


def test_the_model_error_is_an_axis_of_the_grid_and_of_the_table() -> None:
    variants = variants_of(AVAILABLE, ("csc",), (), False)
    flights = flights_of(variants, (0.2,), (1, 2), (0.0, 0.3))
    assert [(f["model_error"], f["seed"]) for f in flights] == [(0.0, 1), (0.0, 2), (0.3, 1), (0.3, 2)]
    groups = aggregate([compare_row(flight, 0.1 + flight["model_error"]) for flight in flights])
    assert [(group.jsonable()["model_error"], len(group.rows)) for group in groups] == [(0.0, 2), (0.3, 2)]
    console = Console(width=200, record=True, file=io.StringIO())
    print_tables(groups, console)
    assert len(re.findall(r"(?m)^.*0.2 kg +│? *30%.*csc/tuned.*0\.4000", console.export_text())) == 1


# -- what it adds up to ------------------------------------------------------------------------------------------------


def test_percentiles_over_seeds_are_values_of_flights() -> None:
    (group,) = aggregate([row(seed, seed / 1000) for seed in range(100, 0, -1)])
    assert group.spread("rms.post.e_p_m") == Spread(0.050, 0.095, 100)
    height = group.spread("final_abs_e_z_m")
    assert height is not None
    assert (height.p50, height.p95) == (0.01, 0.02), "errors of either sign must not cancel"
    assert group.failures == {} and group.failure_text == ""
    (one,) = aggregate([row(1, 0.1)])
    assert one.spread("rms.post.e_p_m") == Spread(0.1, 0.1, 1)


def test_a_crash_counts_as_worse_than_every_other_flight() -> None:
    (group,) = aggregate([row(1, 0.1), row(2, None), row(3, 0.3), row(4, None), row(5, 0.2)])
    assert group.failure_text == "crashed 2 of 5"
    assert group.spread("rms.post.e_p_m") == Spread(0.3, None, 5)
    assert group.spread("rms.pre.e_p_m") == Spread(0.01, 0.01, 5), "it crashed after the catch"
    assert group.jsonable()["completed"] == 3
    assert group.jsonable()["cost_m"] == group.cost > 0.0
    assert group.jsonable()["p95"]["rms"]["post"]["e_p_m"] is None
    (all_crashed,) = aggregate([row(1, None), row(2, None)])
    assert all_crashed.spread("rms.post.e_p_m") is None


def test_a_payload_that_was_not_caught_is_reported() -> None:
    missed = row(1, 0.1, caught=False, catch_t_s=None)
    missed["rms"] = {**missed["rms"], "post": {"e_p_m": None, "e_q_deg": None, "e_alpha_deg": None}}
    (group,) = aggregate([missed, row(2, 0.2)])
    assert group.failure_text == "missed 1 of 2"
    assert group.spread("rms.post.e_p_m") == Spread(0.2, 0.2, 1), "not the law's failure"
    (nothing_thrown,) = aggregate([{**missed, "payload_kg": 0.0}])
    assert nothing_thrown.failures == {}


def test_a_reported_catch_that_was_none_is_counted_and_not_averaged() -> None:
    false, undetected = row(1, 0.1, caught=False), row(3, 0.3, catch_t_s=None)
    (group,) = aggregate([false, row(2, 0.3), undetected])
    assert group.failures == {"missed": 1}
    for name in ("rms.post.e_p_m", "impedance_error.arm_nm", "final_abs_e_z_m", "peak_e_p_m", "torque_activity_nm"):
        spread = group.spread(name)
        assert spread is not None and spread.flights == 2, name
    before = group.spread("rms.pre.e_p_m")
    assert before is not None and before.flights == 3
    assert (group.jsonable()["false_catches"], group.jsonable()["undetected_catches"]) == (1, 1)
    assert compliance_table([group]).rows[0].cells[-2].text == "1, 1"


def test_adaptation_is_compared_flight_by_flight() -> None:
    off = {"preset": "paper - adaptation off"}
    on_m = {1: 0.1, 2: 0.1, 3: 0.3, 4: 0.1, 5: None, 6: None, 7: 0.1}
    off_m = {1: 0.2, 2: 0.3, 3: 0.2, 4: None, 5: 0.2, 6: None, 8: 0.1}
    rows = [*(row(seed, m) for seed, m in on_m.items()), *(row(seed, m, **off) for seed, m in off_m.items())]
    (pairs,) = adaptation_pairs(aggregate(rows))
    assert (pairs.group.preset, len(pairs.base_m_this_m), pairs.better) == ("paper", 5, 3)
    assert pairs.p_value == pytest.approx(2 * (1 + 5 + 10) / 32), "3 of 5, by the binomial distribution"
    assert (pairs.p50(0), pairs.p50(1)) == (0.2, 0.1)
    assert adaptation_pairs(aggregate([row(1, 0.1)])) == []


def test_laws_are_compared_in_the_same_laboratories_with_a_confidence_interval() -> None:
    base = [row(seed, 0.020, preset="recommended") for seed in range(10)]
    other = [row(seed, 0.015 + 0.001 * seed, controller="psc") for seed in range(9)] + [row(9, None, controller="psc")]
    groups = aggregate([*other, *base])
    (pairs,) = pairs_with_reference(groups).values()
    assert pairs.group.label == groups[0].label, "the difference of the other law from adaptive/recommended"
    # Of ten differences the second and the ninth: scipy.stats.quantile_test(d).confidence_interval(0.95) has the same.
    assert pairs.difference_95 == pytest.approx((-0.001, -0.004, 0.003))
    assert difference_text(pairs) == "-1.0 (-4.0 to +3.0)"
    (few,) = pairs_with_reference(aggregate([*other[:5], *base])).values()
    assert (few.difference_95, difference_text(few)) == (None, "")


def test_ten_thousand_laboratories_have_a_confidence_interval_too() -> None:
    pairs = Pairs(aggregate([row(1, 0.1)])[0], [(1.0, 0.001 * n) for n in range(10_000)])
    assert pairs.difference_95 == pytest.approx((3.999, 3.901, 4.098), abs=1e-9)  # ranks 4902 and 5099: 1.96 sigma
    assert pairs.p_value == 0.0


@pytest.mark.parametrize("columns", [70, 200])
def test_no_figure_of_the_table_is_cut_off(columns: int) -> None:
    rows = [row(seed, 0.1234) for seed in (1, 2)] + [row(seed, None, payload_kg=0.3) for seed in (1, 2)]
    console = Console(width=columns)
    with console.capture() as shown:
        print_tables(aggregate(rows), console)
    text = shown.get()
    assert "…" not in text
    for wanted in ("0.1234", "0.1654", "0.0906", "crashed 2 of 2", "0.2 kg", "adaptive/paper"):
        assert wanted in text
    assert console.width == columns
