"""Sections of the simulated world: one module per effect of a laboratory, with its switch and its parameters.

To add a section, add its key to `companion.sitl_config.world.World`, its physics to `sitl.world.effects` (whose docstring says where an
effect acts) and its values to the built-in worlds in `configs/worlds`.
"""

from companion.config.base import Model


class Effect(Model):
    """A section of the world that can be switched off as a whole."""

    on: bool = False
    """Whether this effect acts."""
