"""Effects of a laboratory that the plain simulation leaves out, one module each.

A new effect has a section in `companion.sitl_config.effects`, a key in `companion.sitl_config.world.World`, its physics here, and a
line where it acts: `sitl.world.world` (loads on bodies) or `sitl.world.plant` (sensors and motors).
"""
