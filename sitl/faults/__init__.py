"""Injection of faults into a simulated flight.

A new kind of fault begins in `companion.sitl_config.faults` (`FaultKind` and `KINDS`). Its effect on the world, the sensors and PX4
is in `injector`; faults of the companion's own processes are in `processes`. A line in `companion.campaigns.faults.variants` makes
`companion faults` fly it.
"""
