"""The targets by name. A target's module is imported on demand, because the wires need different drivers."""

from __future__ import annotations

from importlib import import_module
from typing import Final, cast

from benchmarks.fuzzing.campaign import Target

_CLASSES: Final = {
    "natnet": ("natnet", "NatNetTarget"),
    "dynamixel": ("dynamixel", "DynamixelTarget"),
    "dynamixel-wire": ("dynamixel", "DynamixelWireTarget"),
    "force": ("force", "ForceTarget"),
    "mavlink": ("mavlink", "MavlinkTarget"),
    "mavlink-wire": ("mavlink", "MavlinkWireTarget"),
    "channels": ("channels", "ChannelsTarget"),
    "yaml": ("config", "YamlTarget"),
}
NAMES: Final = tuple(_CLASSES)


def target_class(name: str) -> type[Target]:
    """Return the class of a target.

    Raises:
        KeyError: there is none of that name.
    """
    module, cls = _CLASSES[name]
    return cast("type[Target]", getattr(import_module(f"benchmarks.fuzzing.{module}"), cls))
