"""`companion report a.mcap b.mcap`: what it says of two and more flights, and what it must never do to their folders."""

from __future__ import annotations

import copy
import dataclasses
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from companion.analysis.summary import summarise
from companion.campaigns.side_by_side.comparison import Comparison, Figure, NotAlignable, compare, jsonable
from companion.campaigns.side_by_side.flight import Flight, flight_of
from companion.campaigns.side_by_side.page import write_html
from companion.campaigns.side_by_side.plots import write_pictures
from companion.model.outputs import Outputs, Sent
from companion.model.types import Event, Inputs, SafetyAction, Severity
from tests.analysis.synthetic_flight import CATCH_S, CONFIG, GROUND_S, log_of_rows, synthetic_flight

Row = tuple[Inputs, Outputs, Sent]
ROWS = list(synthetic_flight(rate_hz=50.0))
IN_WORLD = CONFIG | {"vehicle": CONFIG["vehicle"] | {"devices": {"arm": {"port": "/dev/pts/4"}}}}
VERSIONS = {"version_companion": "0.1.0", "version_git": "abc", "version_numpy": "2"}


def made(
    letter: str,
    *,
    change: Callable[[Inputs, Outputs, Sent], Row] | None = None,
    rows: list[Row] = ROWS,
    config: dict[str, Any] = IN_WORLD,
    about: dict[str, str] | None = None,
    outcome: str = "completed",
    payload_kg: float | None = 0.2,
    digest: str | None = None,
) -> Flight:
    """A flight of a comparison, from ticks in memory."""
    rows = [change(*row) for row in rows] if change is not None else rows
    about = {**VERSIONS, "epoch_offset_ns": "1700000000000000000", **(about or {})}
    log = log_of_rows(rows, config, path=f"{letter}.mcap", about=about)
    law = config["controller"]
    summary = summarise(log, outcome=outcome, controller=law["law"], preset=law["preset"], payload_kg=payload_kg)
    return flight_of(letter, f"flight {letter}", f"{letter}.mcap", digest or letter, log, summary)


def configured(**changes: Any) -> dict[str, Any]:
    """The configuration with dotted keys changed; `__` for the dot."""
    config = copy.deepcopy(IN_WORLD)
    for key, value in changes.items():
        *path, last = key.split("__")
        part = config
        for name in path:
            part = part.setdefault(name, {})
        part[last] = value
    return config


def further_off(factor: float) -> Callable[[Inputs, Outputs, Sent], Row]:
    def change(i: Inputs, o: Outputs, s: Sent) -> Row:
        assert i.mocap is not None
        if o.reference is None:
            return i, o, s
        pairs = zip(i.mocap.position_world_m, o.reference.position_world_m, strict=True)
        x, y, z = (wanted + factor * (flown - wanted) for flown, wanted in pairs)
        return replace(i, mocap=replace(i.mocap, position_world_m=(x, y, z))), o, s

    return change


def without_events(i: Inputs, o: Outputs, s: Sent) -> Row:
    return i, replace(o, events=()), s


def figure(comparison: Comparison, key: str) -> Figure:
    return next(figure for figure in comparison.figures if figure.key == key)


def keys(comparison: Comparison) -> set[str]:
    return {setting.key for setting in comparison.settings}


# What it says


def test_the_same_recording_twice_shows_no_difference_at_all() -> None:
    comparison = compare([made("A", digest="same"), made("B", digest="same")])
    assert len(comparison.figures) > 25
    assert {difference for figure in comparison.figures for difference in figure.differences} == {0}
    assert {verdict for figure in comparison.figures for verdict in figure.verdicts} == {None}
    assert (comparison.settings, comparison.addresses, comparison.cautions) == ((), (), ())
    assert comparison.fair == "The same recording 2 times: nothing differs."
    others = compare([*comparison.flights, made("C")])
    assert "B is the same recording as A." in others.cautions


def test_a_larger_error_is_worse_by_as_much_as_it_is_larger() -> None:
    comparison = compare([made("A"), *(made(f"{k}", change=further_off(k)) for k in (3.0, 0.5, 1.04))])
    rms = figure(comparison, "rms.post.e_p_m")
    first, second, third, fourth = (value or 0.0 for value in rms.values)
    assert second == pytest.approx(3.0 * first)
    assert list(rms.differences) == pytest.approx([0.0, 2.0 * first, third - first, fourth - first])
    assert rms.verdicts == (None, "worse", "better", None), "a few percent are scatter"
    attitude = figure(comparison, "rms.post.e_q_deg")
    assert set(attitude.differences) == {0.0}
    assert set(attitude.verdicts) == {None}


def test_only_what_is_plainly_better_smaller_is_marked() -> None:
    """Giving way after the catch, being held to other gains, more slack, a later catch: none of it is better or worse."""

    def all_different(i: Inputs, o: Outputs, s: Sent) -> Row:
        i, o, s = further_off(3.0)(i, o, s)
        assert i.arm is not None
        angle = (i.arm.angle_rad[0] + 0.2, i.arm.angle_rad[1])
        return replace(i, arm=replace(i.arm, angle_rad=angle)), o, replace(s, lateness_s=s.lateness_s + 0.002)

    other = made("B", change=all_different, config=configured(controller__phi=[3.0] * 8))
    comparison = compare([made("A"), other])
    marked = {figure.key for figure in comparison.figures if any(figure.verdicts)}
    assert marked == {"rms.pre.e_p_m", "rms.pre.e_alpha_deg", "rms.post.e_p_m"} | {
        f"loop.lateness_ms.{part}" for part in ("p50", "p99", "max")
    }
    arm = figure(comparison, "rms.post.e_alpha_deg")
    assert (arm.differences[1] or 0.0) > 5.0


def test_every_number_of_a_summary_is_in_the_table_also_one_that_came_later() -> None:
    flights = [made("A"), made("B")]
    for n, flight in enumerate(flights):
        flight.summary["news"] = {"depth_m": 1.5 * n, "name": "text", "flag": True}
    comparison = compare(flights)
    shown = {figure.key for figure in comparison.figures}
    assert {"rms.pre.e_p_m", "loop.lateness_ms.p99", "payload_kg", "tether.min_slack_m"} <= shown
    assert figure(comparison, "news.depth_m").differences == (0.0, 1.5)
    assert {"news.name", "news.flag"}.isdisjoint(shown)


def test_what_one_flight_did_not_measure_has_no_difference() -> None:
    rms = figure(compare([made("A"), made("B", change=without_events)]), "rms.post.e_p_m")
    assert rms.values[0] is not None
    assert (rms.values[1], rms.differences[1], rms.verdicts[1]) == (None, None, None)


def test_a_flight_that_was_not_completed_is_never_better_for_having_ended_early() -> None:
    late = [row for row in ROWS if row[1].mission_t_s < 5.0]
    comparison = compare([made("A", change=further_off(3.0)), made("B", rows=late, outcome="aborted")])
    assert (figure(comparison, "rms.pre.e_p_m").differences[1] or 0.0) < 0.0
    assert figure(comparison, "rms.pre.e_p_m").verdicts == (None, None)
    assert any("Not completed: B (aborted)" in caution for caution in comparison.cautions)


# The configurations


def test_keys_that_differ_are_listed_and_no_others() -> None:
    phases: list[dict[str, Any]] = [{"type": "takeoff", "height_m": 1.0}, {"type": "land"}]
    one = configured(mission__phases=phases, controller__phi=[1.0, 2.0], vehicle__tether=None, world__wind=[0, 0])
    other = configured(
        mission__phases=[phases[0] | {"height_m": 1.2}], controller__phi=[1.0, 3.0], controller__rho_max=6.0, world__wind=[0.0, 0.0]
    )  # fmt: skip
    comparison = compare([made("A", config=one), made("B", config=other)])
    settings = {setting.key: setting for setting in comparison.settings}
    assert set(settings) == {
        "mission.phases[0].height_m",
        "mission.phases[1].type",
        "controller.phi",
        "controller.rho_max",
        "vehicle.tether.anchor_world_m",
        "vehicle.tether.length_m",
        "vehicle.tether.attachment_body_m",
    }
    assert settings["controller.phi"].values == ([1.0, 2.0], [1.0, 3.0])
    assert settings["controller.rho_max"].present == (False, True)
    assert settings["mission.phases[1].type"].present == (True, False)
    rows = {row["key"]: row for row in jsonable(comparison)["configuration"]}
    assert rows["controller.rho_max"] == {"key": "controller.rho_max", "values": (None, 6.0), "absent": ["A"]}


def test_addresses_of_the_simulated_world_are_distinguished_from_settings_but_not_those_of_a_vehicle() -> None:
    def arm_on(port: str) -> dict[str, Any]:
        return configured(vehicle__devices={"arm": {"port": port}, "mocap": {"rate_hz": 200.0}})

    simulated = compare([made(n, config=arm_on(f"/dev/pts/{n}")) for n in "AB"])
    assert (keys(simulated), [s.key for s in simulated.addresses]) == (set(), ["vehicle.devices.arm.port"])
    assert simulated.cautions == ()
    real = compare([made(n, config=arm_on(f"/dev/ttyUSB{n}")) for n in "AB"])
    assert (keys(real), real.addresses) == ({"vehicle.devices.arm.port"}, ())


@pytest.mark.parametrize(("server", "payload_known"), [("127.0.0.1", True), ("192.168.1.10", False)])
def test_without_an_arm_a_flight_is_simulated_if_motion_capture_is_on_this_computer(
    server: str, payload_known: bool
) -> None:
    config = configured(vehicle__devices={"arm": None, "mocap": {"server": server}}, world__payload_kg=0.2)
    comparison = compare([made(n, config=config, payload_kg=None) for n in "AB"])
    assert (comparison.cautions == ()) == payload_known


def test_the_world_section_of_a_flight_on_the_vehicle_is_not_compared() -> None:
    flights = [
        made(n, config=configured(vehicle__devices={"arm": {"port": "/dev/ttyUSB0"}}, world__seed=k), payload_kg=None)
        for k, n in enumerate("AB")
    ]
    comparison = compare(flights)
    assert keys(comparison) == set()
    assert dict(comparison.about)["world"] == ("–", "–")
    assert comparison.cautions == ("The payload of A, B is not known; it may differ.",)


# Whether it is a fair comparison


def test_flights_that_differ_in_their_law_only_are_comparable() -> None:
    other = configured(controller={"law": "csc", "preset": "tuned", "gain": 1.0})
    other["sources"] = {"controller": "elsewhere.yaml"}
    comparison = compare([made("A"), made("B", config=other)])
    assert re.fullmatch(r"Only the law or its gains differ \(\d+ keys\)\.", comparison.fair)
    assert comparison.cautions == ()


@pytest.mark.parametrize(
    ("changes", "caution"),
    [
        ({"config": configured(world__payload_kg=0.3), "payload_kg": 0.3}, "Different payload: A 0.2 kg, B 0.3 kg."),
        ({"config": configured(world__seed=7)}, "Different seed: A –, B 7."),
        ({"config": configured(vehicle__airframe__mass_kg=3.2)}, "Different vehicle (1 key): vehicle.airframe.mass_kg."),
        ({"config": configured(world__faults=[{"kind": "push"}])}, "Different world (1 key): world.faults[0].kind."),
        ({"about": {"version_git": "def"}}, "Different versions of companion: A 0.1.0 abc, B 0.1.0 def."),
        (
            {"config": configured(vehicle__devices={"arm": {"port": "/dev/ttyUSB0"}})},
            "Flown in different places: A in the simulated world, B on the vehicle.",
        ),
        ({"rows": ROWS[::2]}, "Different rates of the control loop: A 50 Hz, B 25 Hz."),
    ],
)  # fmt: skip
def test_every_other_difference_is_a_caution(changes: dict[str, Any], caution: str) -> None:
    config = copy.deepcopy(changes.pop("config", IN_WORLD))
    config["controller"] = {**config["controller"], "preset": "paper"}
    if "rows" in changes:
        changes["rows"] = [
            (replace(i, tick=k), replace(o, tick=k), replace(s, tick=k)) for k, (i, o, s) in enumerate(changes["rows"])
        ]
    comparison = compare([made("A"), made("B", config=config, **changes)])
    assert caution in comparison.cautions
    assert "and so do the settings below" in comparison.fair


def test_different_missions_are_not_marked_better_or_worse_but_their_timing_is() -> None:
    def slower(i: Inputs, o: Outputs, s: Sent) -> Row:
        return further_off(3.0)(i, o, replace(s, lateness_s=3.0 * s.lateness_s))

    comparison = compare([made("A"), made("B", change=slower, config=configured(mission__name="hover"))])
    assert figure(comparison, "rms.pre.e_p_m").verdicts == (None, None)
    assert figure(comparison, "loop.lateness_ms.p99").verdicts == (None, "worse")


# The common time axis


def test_flights_are_aligned_at_the_catch_each_at_its_own() -> None:
    shifted = [(replace(i, t_s=i.t_s + 40.0), o, s) for i, o, s in ROWS]
    shifted = [(i, replace(o, events=tuple(replace(e, t_s=e.t_s + 40.0) for e in o.events)), s) for i, o, s in shifted]
    comparison = compare([made("A"), made("B", rows=shifted)])
    assert comparison.align == "catch"
    assert list(comparison.zeros_s) == pytest.approx([GROUND_S + CATCH_S, GROUND_S + CATCH_S + 40.0])


def test_without_a_catch_in_one_of_them_they_are_aligned_at_the_take_off_and_the_page_notes_it(tmp_path: Path) -> None:
    flights = [made("A"), made("B", change=without_events)]
    comparison = compare(flights)
    assert comparison.align == "takeoff"
    assert list(comparison.zeros_s) == pytest.approx([GROUND_S, GROUND_S])
    assert "No catch in B." in comparison.notes
    write_html(comparison, [], tmp_path / "page.html")
    assert "No catch in B." in (tmp_path / "page.html").read_text(encoding="utf-8")
    with pytest.raises(NotAlignable, match=r"^B\.mcap: --align catch: there is no catch in this flight$"):
        compare(flights, "catch")


def test_a_flight_that_never_took_off_is_aligned_at_its_start() -> None:
    comparison = compare([made("A"), made("B", rows=ROWS[:50], outcome="refused")])
    assert (comparison.align, comparison.zeros_s) == ("start", (0.0, 0.0))
    assert "No take-off in B." in comparison.notes
    with pytest.raises(NotAlignable, match="no take-off"):
        compare(comparison.flights, "takeoff")


# The pictures


def test_pictures_of_flights_that_hardly_began_are_drawn_all_the_same(tmp_path: Path) -> None:
    bare = [(replace(i, mocap=None, arm=None), replace(o, control=None, reference=None), s) for i, o, s in ROWS[:3]]
    comparison = compare([made("A", rows=bare, outcome="aborted"), made("B", rows=bare[:1], outcome="lost")])
    pictures = write_pictures(comparison, tmp_path)
    write_html(comparison, pictures, tmp_path / "page.html")
    assert "side_by_side_lateness" in {picture.path.stem for picture in pictures}


# The page


@pytest.mark.usefixtures("undrawn")
def test_markup_in_a_log_is_text_on_the_page(tmp_path: Path) -> None:
    evil = "<script>alert('$x$')</script>"

    def shout(i: Inputs, o: Outputs, s: Sent) -> Row:
        event = Event(t_s=i.t_s, id=evil, severity=Severity.WARNING, action=SafetyAction.HOLD, text=evil)
        return i, replace(o, events=(*o.events, event) if i.tick == 375 else o.events), s

    config = configured(mission__name=evil, controller__preset=evil, controller__note=evil, sources__overrides=[evil])
    config[evil] = {evil: evil}
    bad = dataclasses.replace(
        made("B", change=shout, config=config, about={"version_git": evil, "version_companion": evil}),
        name=evil,
        path=evil,
    )
    bad.summary["outcome"] = evil
    bad.summary["autopilot"] = {"kind": evil, "firmware": evil}
    bad.summary[evil] = 1.0
    comparison = compare([made("A"), bad])
    write_html(comparison, write_pictures(comparison, tmp_path), tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<script" not in page
    assert page.count("&lt;script&gt;") > 15
    assert not re.search(r"""(?:src|href)=['"](?!data:)""", page)


@pytest.mark.usefixtures("undrawn")
def test_the_page_shows_the_figures_the_settings_and_the_events(tmp_path: Path) -> None:
    other = made("B", change=further_off(3.0), config=configured(controller__rho_max=7.25))
    comparison = compare([made("A"), other])
    write_html(comparison, write_pictures(comparison, tmp_path), tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    for flight in comparison.flights:
        assert f"{flight.summary['rms']['post']['e_p_m']:.4f}" in page
    for told in (
        "Only the law or its gains differ (1 key).",
        "controller.rho_max",
        "7.25",
        "(+200\u00a0%)",
        "worse</small>",
        "payload in the net",
    ):
        assert told in page, told
    assert page.count("data:image/png;base64,") == 4
    assert "nan" not in re.sub(r'base64,[^"]*', "", page)
