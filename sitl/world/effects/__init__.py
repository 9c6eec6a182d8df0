"""Effects of a laboratory that the plain simulation omits, one module each.

To add an effect, write its section in `companion.sitl_config.effects`, its key in `companion.sitl_config.world.World` and its physics
here; then apply it in `sitl.world.machine` (loads on bodies), `sitl.mocap` or `sitl.plant` (other sensors and motors).
"""
