"""The registry of plug-ins: where it finds them, in which order, and what it says of those that cannot be loaded."""

from __future__ import annotations

import importlib.metadata
from pathlib import Path

import pytest

from companion import DISTRIBUTION, __version__, plugins
from companion.config.controller import LAWS, PRESETS, AdaptiveConfig
from companion.plugins import CONTROL_LAWS, PluginError
from tests.plugins.installed import on_path, write_distribution
from tests.support import ROOT


def test_the_laws_of_the_companion_are_announced_as_every_other() -> None:
    found = plugins.installed(CONTROL_LAWS)
    assert list(found)[:4] == ["adaptive", "csc", "psc", "policy"]
    assert str(found["csc"]) == f"control law 'csc' ({DISTRIBUTION} {__version__})"
    assert LAWS["adaptive"] is AdaptiveConfig
    assert PRESETS["psc"][-1] == "tuned"
    with pytest.raises(KeyError):
        PRESETS["lqr"]


def test_without_a_source_tree_the_metadata_of_the_installation_announce_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a wheel. An editable installation that is older than pyproject.toml announces nothing, and the source tree is read."""
    monkeypatch.setattr(plugins, "_SOURCE_TREE", tmp_path)
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: [])
    plugins.installed.cache_clear()
    assert plugins.installed(CONTROL_LAWS) == {}
    monkeypatch.setattr(plugins, "_SOURCE_TREE", ROOT)
    plugins.installed.cache_clear()
    assert list(plugins.installed(CONTROL_LAWS)) == ["adaptive", "csc", "psc", "policy"]
    monkeypatch.undo()
    monkeypatch.setattr(plugins, "_SOURCE_TREE", tmp_path)
    write_distribution(tmp_path, DISTRIBUTION, __version__, {"psc": "companion.control.psc:PscController"})
    with on_path(tmp_path):
        assert plugins.installed(CONTROL_LAWS)["psc"].distribution == DISTRIBUTION


def test_the_laws_of_others_follow_in_the_order_of_their_names(tmp_path: Path) -> None:
    write_distribution(tmp_path, "lab-b", "2.0", {"swing": "lab_b:Law", "Lift": "lab_b:Law"})
    with on_path(tmp_path):
        assert list(PRESETS) == ["adaptive", "csc", "psc", "policy", "Lift", "swing"]
        assert str(plugins.find(CONTROL_LAWS, "swing")) == "control law 'swing' (lab-b 2.0)"
    assert "swing" not in PRESETS


@pytest.mark.parametrize(
    ("target", "source", "reason"),
    [
        ("lab_a:Law", None, "lab_a:Law cannot be imported: ModuleNotFoundError: No module named 'lab_a'"),
        ("lab_a:Law", "", "lab_a:Law cannot be imported: AttributeError: module 'lab_a' has no attribute 'Law'"),
        ("lab_a:Law", "raise SystemExit('no\\nlicence')", "lab_a:Law cannot be imported: SystemExit: no"),
    ],
)
def test_a_plug_in_that_cannot_be_imported_is_named_in_one_line(
    tmp_path: Path, target: str, source: str | None, reason: str
) -> None:
    write_distribution(tmp_path, "lab-a", "1.0", {"lift": target})
    if source is not None:
        (tmp_path / "lab_a.py").write_text(source)
    with on_path(tmp_path), pytest.raises(PluginError) as caught:
        plugins.find(CONTROL_LAWS, "lift").load()
    assert str(caught.value) == f"control law 'lift' (lab-a 1.0): {reason}"


def test_a_name_that_two_distributions_announce_is_refused(tmp_path: Path) -> None:
    write_distribution(tmp_path, "lab-a", "1.0", {"adaptive": "lab_a:Law"})
    with (
        on_path(tmp_path),
        pytest.raises(PluginError, match=r"\(lab-a 1\.0\) has the same name; uninstall one of them"),
    ):
        LAWS["adaptive"]


def test_a_plug_in_that_is_absent_is_named_with_those_that_are_there() -> None:
    with pytest.raises(
        PluginError, match=r"^control law 'lift': is not installed; installed: adaptive, csc, psc, policy$"
    ):
        plugins.find(CONTROL_LAWS, "lift")
