"""Control laws: from inputs and a reference to an attitude setpoint and joint torques. Pure.

A law is a plug-in: an entry point in the group `companion.control_laws` names its class (`types.Law`). A new law of the companion
has its settings in `companion.config.controller`, its gains in `configs/controllers`, its equations in a module
here, and its entry point in pyproject.toml. `vehicle_control` runs a law in every tick, `common` contains what all laws share,
`thrust` converts a force to attitude and thrust, and `sensing` detects the catch. Estimates of unknown loads start at zero:
`load_adaptation` (adaptive), `payload_mass` (psc) and `disturbance` (any law).
"""
