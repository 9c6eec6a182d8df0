"""Plug-ins: parts of the companion that any installed distribution can provide and announces by entry points (`importlib.metadata`).

The companion announces its own parts in the same way, in pyproject.toml.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from companion import DISTRIBUTION, __version__

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

CONTROL_LAWS = "companion.control_laws"
MOCAP_SYSTEMS = "companion.mocap_systems"
FORCE_SENSORS = "companion.force_sensors"
ARMS = "companion.arms"
PHASES = "companion.phases"
KINDS = {
    CONTROL_LAWS: "control law",
    MOCAP_SYSTEMS: "motion-capture system",
    FORCE_SENSORS: "force sensor",
    ARMS: "arm",
    PHASES: "phase",
}
"""Kind of part, in words, that each group of entry points announces."""
_SOURCE_TREE = Path(__file__).parents[2]


class PluginError(Exception):
    """A plug-in cannot be used; the text is one line that names the plug-in and the reason."""

    def __init__(self, plugin: object, reason: str) -> None:
        super().__init__(f"{plugin}: {reason}")
        self.reason = reason


@dataclass(frozen=True)
class Plugin:
    """An announced part. Its module is not imported before `load`."""

    entry: EntryPoint
    distribution: str
    version: str
    others: list[Plugin] = field(default_factory=list)
    """Parts with the same name from other distributions; if there are any, none of the parts can be used."""

    def __str__(self) -> str:
        return f"{KINDS[self.entry.group]} '{self.entry.name}' ({self.distribution} {self.version})"

    @property
    def own(self) -> bool:
        """Whether the companion itself provides it."""
        return self.distribution == DISTRIBUTION

    def load(self) -> Any:
        """Import the module and return the announced object.

        Raises:
            PluginError: another distribution announces the same name, or the object cannot be imported.
        """
        if self.others:
            raise self.error(f"{' and '.join(map(str, self.others))} has the same name; uninstall one of them")
        try:
            return self.entry.load()
        except (Exception, SystemExit) as error:
            raise self.error(f"{self.entry.value} cannot be imported: {one_line(error)}") from error

    def error(self, reason: str) -> PluginError:
        """Return an error which states that this plug-in cannot be used, and the reason."""
        return PluginError(self, reason)


def one_line(error: BaseException) -> str:
    """Return the type of an exception and the first line of its text as one line."""
    return ": ".join([type(error).__name__, *str(error).splitlines()[:1]])


@functools.cache
def installed(group: str) -> dict[str, Plugin]:
    """Return the installed plug-ins of a group by name: the companion's own, then other distributions' in order of name."""
    found: dict[str, Plugin] = {}
    for plugin in [*_own(group), *sorted(_of_others(group), key=lambda plugin: plugin.entry.name)]:
        first = found.setdefault(plugin.entry.name, plugin)
        if first is not plugin:
            first.others.append(plugin)
    return found


def find(group: str, name: str) -> Plugin:
    """Return an installed plug-in.

    Raises:
        PluginError: no plug-in of this name is installed.
    """
    plugins = installed(group)
    if name not in plugins:
        raise PluginError(f"{KINDS[group]} '{name}'", f"is not installed; installed: {', '.join(plugins) or 'none'}")
    return plugins[name]


def _own(group: str) -> Iterator[Plugin]:
    """Yield the companion's own parts; a source tree's from pyproject.toml, as an editable installation keeps old entry points."""
    import tomllib  # 0.1 s with importlib.metadata, which a guardian for NatNet does without
    from importlib.metadata import EntryPoint, entry_points

    path = _SOURCE_TREE / "pyproject.toml"
    source = tomllib.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    announced = source.get("project", {}).get("entry-points", {}).get(group)
    if announced is not None:
        entries = [EntryPoint(name, target, group) for name, target in announced.items()]
    else:
        entries = [entry for entry in entry_points(group=group) if _is_own(entry)]
    for entry in entries:
        yield Plugin(entry, DISTRIBUTION, __version__)


def _of_others(group: str) -> Iterator[Plugin]:
    from importlib.metadata import entry_points  # as in `_own`

    for entry in entry_points(group=group):
        if entry.dist is not None and not _is_own(entry):
            yield Plugin(entry, entry.dist.name, entry.dist.version)


def _is_own(entry: EntryPoint) -> bool:
    return entry.module.split(".")[0] == "companion"
