"""Injection of faults into a simulated flight.

To add a kind of fault, begin in `companion.sitl_config.faults` (`KINDS`). Implement its effect on the world, the
sensors and PX4 in `injector`; faults of the companion's own processes are in `processes`. `companion faults` flies
it with its default size; other sizes and durations are in `companion.campaigns.faults.variants`.
"""
