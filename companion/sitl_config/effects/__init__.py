"""Sections of the simulated world: one module per effect of a laboratory, with its switch and its parameters.

A new section is also a key of `companion.sitl_config.world.World`. Its physics is in `sitl.world.effects`, which says where it acts;
its values in the built-in worlds are in `configs/worlds`.
"""
