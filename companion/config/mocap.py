"""Motion-capture systems other than NatNet: plug-ins that `devices.mocap.type` names (`companion.plugins.MOCAP_SYSTEMS`)."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import ValidationError

from companion import plugins
from companion.config.base import Location, Model

NATNET = "natnet"
"""The built-in system, OptiTrack Motive over NatNet; it is no plug-in."""


@functools.cache
def system_class(name: str) -> Any:
    """Return the class of an installed system; `companion.io.mocap.system.PoseClient` describes it.

    Raises:
        PluginError: the system is not installed, cannot be imported, or has no model of its options.
    """
    plugin = plugins.find(plugins.MOCAP_SYSTEMS, name)
    found = plugin.load()
    options = getattr(found, "options", None)
    if not (isinstance(options, type) and issubclass(options, Model)):
        raise plugin.error("its attribute 'options' is not a subclass of companion.config.base.Model")
    return found


def problems(name: str, options: Mapping[str, Any]) -> list[tuple[Location, str]]:
    """Return what is wrong with `type` and `options` of `devices.mocap`, by key."""
    if name == NATNET:
        return (
            [(("options",), f"must be empty for {NATNET}, whose settings are keys of devices.mocap")] if options else []
        )
    try:
        system_class(name).options.model_validate(dict(options))
    except plugins.PluginError as error:
        return [(("type",), f"{error} (built in: {NATNET})")]
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
"""Model of `devices.mocap.options` of each installed system; raises PluginError if the system cannot be used."""
