"""The layouts for Foxglove and PlotJuggler: each of their paths exists in the log of a real flight."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import foxglove.layouts
import pytest

from companion.config.base import JOINTS_MAX
from tests.recorder.viewers import Viewed, at_path, split_path

pytestmark = pytest.mark.xdist_group("recorded flight")

FOXGLOVE = Path("configs/foxglove/companion.json")
TEAM = Path("configs/foxglove/team.json")
PLOTJUGGLER = Path("configs/plotjuggler/companion.xml")
PANELS: dict[str, Any] = {
    "3D": foxglove.layouts.ThreeDeeConfig,
    "Plot": foxglove.layouts.PlotConfig,
    "RosOut": foxglove.layouts.LogConfig,
    "StateTransitions": foxglove.layouts.StateTransitionsConfig,
}
"""By panel type in saved layouts: its configuration class in the SDK."""
JOINT_PATHS = {
    "/inputs.arm.angle_rad": 0,
    "/outputs.reference.arm_rad": 0,
    "/outputs.control.tau": 6,
    "/sent.arm_torque_sent_nm": 0,
}
"""Message paths with one value per joint, and the index of joint 1."""


@pytest.fixture(scope="module")
def layout() -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads(FOXGLOVE.read_text())
    return loaded


def panels(layout: dict[str, Any], kind: str) -> Iterator[dict[str, Any]]:
    for name, config in layout["configById"].items():
        if name.partition("!")[0] == kind:
            yield config


def leaves(tree: Any) -> Iterator[str]:
    if isinstance(tree, str):
        yield tree
        return
    assert tree.keys() == {"direction", "first", "second", "splitPercentage"}
    assert tree["direction"] in ("row", "column")
    assert 0 < tree["splitPercentage"] < 100
    yield from leaves(tree["first"])
    yield from leaves(tree["second"])


def foxglove_paths(layout: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """(panel type, message path)."""
    for kind in ("Plot", "StateTransitions"):
        for panel in panels(layout, kind):
            yield from ((kind, series["value"]) for series in panel["paths"])


def resolve(viewed: Viewed, kind: str, path: str) -> None:
    """Find the path in the flight. Its arm has two joints: paths of joints 3 to 7 are looked up as joint 2."""
    for base, first in JOINT_PATHS.items():
        joint = path.removeprefix(f"{base}[")
        if joint != path and first + 2 <= int(joint.removesuffix("]")) < first + JOINTS_MAX:
            path = f"{base}[{first + 1}]"
    topic, steps = split_path(path)
    values = [at_path(message.data, steps) for message in viewed.by_topic[topic]]
    found = [value for value in values if value is not None]
    assert found, f"{path}: in no message"
    wanted: tuple[type, ...] = (int, float) if kind == "Plot" else (int, float, str, bool)
    assert all(type(value) in wanted for value in found), f"{path}: a {kind} panel cannot show {found[0]!r:.40}"


def test_every_path_of_the_foxglove_layout_is_in_a_flight(layout: dict[str, Any], viewed: Viewed) -> None:
    paths = list(foxglove_paths(layout))
    assert len(paths) > 30
    wanted = {f"{base}[{first + n}]" for base, first in JOINT_PATHS.items() for n in range(JOINTS_MAX)}
    assert wanted <= {path for _, path in paths}, "every joint is plotted"
    for kind, path in paths:
        resolve(viewed, kind, path)
    for panel in panels(layout, "RosOut"):
        assert viewed.schemas[panel["topicToRender"]][1] == "foxglove.Log"
    for panel in panels(layout, "3D"):
        assert panel["topics"].keys() <= viewed.schemas.keys()
        named = {panel["fixedFrame"], panel["followTf"], *(layer["frameId"] for layer in panel["layers"].values())}
        assert named <= viewed.frames()


@pytest.mark.parametrize("path", ["/outputs.control.erorr[0]", "/outputs.control.error", "/inputs.status.mode"])
def test_a_path_that_a_plot_cannot_show_is_found(viewed: Viewed, path: str) -> None:
    with pytest.raises(AssertionError):
        resolve(viewed, "Plot", path)


@pytest.mark.parametrize("path", [FOXGLOVE, TEAM])
def test_the_foxglove_layout_has_the_form_of_a_saved_one(path: Path) -> None:
    layout = json.loads(path.read_text())
    assert layout.keys() == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}
    shown = list(leaves(layout["layout"]))
    for panel in panels(layout, "Tab"):
        assert 0 <= panel["activeTabIdx"] < len(panel["tabs"])
        shown += [leaf for tab in panel["tabs"] for leaf in leaves(tab["layout"])]
    assert sorted(shown) == sorted(layout["configById"]), "each panel is shown once"
    for name, config in layout["configById"].items():
        kind = name.partition("!")[0]
        if kind != "Tab":
            assert config.keys() <= {"foxglovePanelTitle", *PANELS[kind]()._to_dict()}, name
    known = foxglove.layouts.PlotSeries()._to_dict().keys()
    assert all(series.keys() <= known for panel in panels(layout, "Plot") for series in panel["paths"])


def test_every_series_of_the_plotjuggler_layout_is_in_a_flight(viewed: Viewed) -> None:
    curves = list(ET.parse(PLOTJUGGLER).getroot().iter("curve"))
    names = {curve.get(key) for curve in curves for key in ("curve_x", "curve_y") if curve.get("curve_x")}
    names |= {curve.get("name") for curve in curves if not curve.get("curve_x")}
    assert len(names) > 30
    assert names - viewed.series == set()


def test_the_plotjuggler_layout_has_the_form_of_a_saved_one() -> None:
    root = ET.parse(PLOTJUGGLER).getroot()
    assert root.tag == "root"
    for splitter in root.iter("DockSplitter"):
        assert len(splitter) == int(splitter.attrib["count"]) == len(splitter.attrib["sizes"].split(";"))
        assert splitter.attrib["orientation"] in ("-", "|")
    for tab in root.iter("Tab"):
        assert len(tab.findall("Container")) == int(tab.attrib["containers"])
    for plot in root.iter("plot"):
        together = plot.attrib["mode"] == "XYPlot"
        assert plot.attrib["mode"] in ("TimeSeries", "XYPlot")
        assert all(together == ("curve_x" in curve.attrib) for curve in plot.iter("curve"))
        assert plot.find("curve") is not None


def test_a_series_that_is_not_there_is_found(viewed: Viewed) -> None:
    without = replace(viewed, messages=tuple(m for m in viewed.messages if m.topic != "/pose"))
    assert "/pose/pose/position/x" in viewed.series
    assert "/pose/pose/position/x" not in without.series
