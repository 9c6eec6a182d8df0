"""Types of devices: those that the companion provides, and plug-ins (`companion.plugins`). `type` and `options` of `devices.mocap`,
`devices.force` and `devices.arm` name them.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from companion import plugins
from companion.config.base import Location, Model

NATNET = "natnet"
EXTERNAL = "external"
"""Another program feeds PX4 with poses; the companion reads no motion capture."""
RFT60 = "rft60"
DYNAMIXEL = "dynamixel"
BUILT_IN = {
    plugins.MOCAP_SYSTEMS: (NATNET, EXTERNAL),
    plugins.FORCE_SENSORS: (RFT60,),
    plugins.ARMS: (DYNAMIXEL,),
}
"""Types that the companion provides, by group; all but external are announced as plug-ins are."""


@functools.cache
def device_class(group: str, name: str, methods: tuple[str, ...] = ()) -> Any:
    """Return the class of an installed device.

    Args:
        group: group of entry points, such as `companion.plugins.FORCE_SENSORS`.
        methods: names of the methods that it must have.

    Raises:
        PluginError: the device is not installed, cannot be imported, has no model for its options or lacks a method.
    """
    plugin = plugins.find(group, name)
    found = plugin.load()
    options = getattr(found, "options", None)
    if not (isinstance(options, type) and issubclass(options, Model)):
        raise plugin.error("its attribute 'options' is not a subclass of companion.config.base.Model")
    for method in methods:
        if not callable(getattr(found, method, None)):
            raise plugin.error(f"its class has no method {method}()")
    return found


def sees_markers(mocap_type: str) -> bool:
    """Return whether an installed motion-capture system hands on single markers.

    Raises:
        PluginError: as `device_class`.
    """
    return mocap_type == NATNET or bool(getattr(device_class(plugins.MOCAP_SYSTEMS, mocap_type), "sees_markers", False))


def problems(group: str, name: str, options: Mapping[str, Any]) -> list[tuple[Location, str]]:
    """Return the problems of `type` and `options` of a device, each with the key to which it belongs."""
    built_in = BUILT_IN[group]
    if name in built_in and not options:
        return []  # nothing to check: the search for plug-ins takes some hundredths of a second
    if name == EXTERNAL and name in built_in:
        return [(("options",), "Extra inputs are not permitted")]
    try:
        device_class(group, name).options.model_validate_json(json.dumps(dict(options)), strict=True)
    except plugins.PluginError as error:
        return [(("type",), str(error))]
    except ValidationError as error:
        return [(("options", *detail["loc"]), detail["msg"]) for detail in error.errors(include_url=False)]
    return []
