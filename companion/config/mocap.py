"""Motion-capture systems other than NatNet, which are plug-ins (`companion.plugins.MOCAP_SYSTEMS`); `devices.mocap.type` names one."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import ValidationError

from companion import plugins
from companion.config.base import Location, Model

NATNET = "natnet"
"""Name of the built-in system, OptiTrack Motive over NatNet, which is not a plug-in."""
EXTERNAL = "external"
"""Another program feeds PX4 with poses; the companion reads no motion capture."""


@functools.cache
def system_class(name: str) -> Any:
    """Return the class of an installed system, which implements `companion.io.mocap.system.PoseClient`.

    Raises:
        PluginError: the system is not installed, cannot be imported or has no model for its options.
    """
    plugin = plugins.find(plugins.MOCAP_SYSTEMS, name)
    found = plugin.load()
    options = getattr(found, "options", None)
    if not (isinstance(options, type) and issubclass(options, Model)):
        raise plugin.error("its attribute 'options' is not a subclass of companion.config.base.Model")
    return found


def problems(name: str, options: Mapping[str, Any]) -> list[tuple[Location, str]]:
    """Return the problems of `type` and `options` in `devices.mocap`, each with the key to which it belongs."""
    if name in (NATNET, EXTERNAL):
        why = "whose settings are keys of devices.mocap" if name == NATNET else "which has no settings"
        return [(("options",), f"must be empty for {name}, {why}")] if options else []
    try:
        system_class(name).options.model_validate(dict(options))
    except plugins.PluginError as error:
        return [(("type",), f"{error} (built in: {NATNET}, {EXTERNAL})")]
    except ValidationError as error:
        return [(("options", *detail["loc"]), detail["msg"]) for detail in error.errors(include_url=False)]
    return []


class _OptionsOfSystems(Mapping[str, type[Model]]):
    def __getitem__(self, name: str) -> type[Model]:
        if name not in plugins.installed(plugins.MOCAP_SYSTEMS):
            raise KeyError(name)
        options: type[Model] = system_class(name).options
        return options

    def __iter__(self) -> Iterator[str]:
        return iter(plugins.installed(plugins.MOCAP_SYSTEMS))

    def __len__(self) -> int:
        return len(plugins.installed(plugins.MOCAP_SYSTEMS))


SYSTEMS: Mapping[str, type[Model]] = _OptionsOfSystems()
"""Model of `devices.mocap.options` for each installed system. Access raises PluginError if the system cannot be used."""
