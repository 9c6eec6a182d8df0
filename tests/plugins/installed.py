"""Distributions that tests install: a folder on sys.path with packages and the metadata that pip would write."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from companion import plugins
from companion.config.controller import law_class
from companion.config.device_plugins import device_class
from companion.config.explain import schema_of
from companion.config.phase import forget_phases
from companion.config.shipped import FILES


def write_distribution(
    site: Path, name: str, version: str, entry_points: Mapping[str, str], group: str = plugins.CONTROL_LAWS
) -> None:
    """Write the metadata of a distribution with these plug-ins, NAME: MODULE:ATTRIBUTE."""
    info = site / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    lines = [f"[{group}]", *(f"{plugin} = {target}" for plugin, target in entry_points.items())]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")


@contextmanager
def on_path(site: Path) -> Iterator[None]:
    """Install the distributions of a folder in this process."""
    modules = set(sys.modules)
    sys.path.insert(0, str(site))
    _forget()
    try:
        yield
    finally:
        sys.path.remove(str(site))
        for name in set(sys.modules) - modules:
            if str(getattr(sys.modules[name], "__file__", "")).startswith(str(site)):
                del sys.modules[name]
        _forget()


def _forget() -> None:
    plugins.installed.cache_clear()
    device_class.cache_clear()
    law_class.cache_clear()
    schema_of.cache_clear()
    forget_phases()


LAW = """
from typing import Literal
from companion.config.controller import PscConfig
from companion.control.psc import PscController

class LiftConfig(PscConfig):
    '''A law for tests.'''
    presets = ("stiff", "soft")
    law: Literal["lift"]
    lift_n: float = 0.0

class Lift(PscController):
    settings = LiftConfig
"""
"""Module of a control law that flies as psc does."""
STEP = """
    def step(self, dt_s, state, reference, vertical_scale):
        wrench = super().step(dt_s, state, reference, vertical_scale)
        """
"""The begin of a method for `LAW`."""


def write_law(site: Path, law: str = LAW, version: str = "1.0") -> None:
    """Write the distribution lab-a with the law `lift` and its presets."""
    write_distribution(site, "lab-a", version, {"lift": "lab_a:Lift"})
    (site / "lab_a.py").write_text(law)
    gains = FILES / "controllers" / "psc_tuned.yaml"
    folder = site / "files" / "controllers"
    folder.mkdir(parents=True)
    for preset in ("stiff", "soft"):
        text = (
            gains.read_text(encoding="utf-8")
            .replace("law: psc", "law: lift")
            .replace("preset: tuned", f"preset: {preset}")
        )
        (folder / f"lift_{preset}.yaml").write_text(text, encoding="utf-8")
