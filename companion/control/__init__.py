"""Control laws: from inputs and a reference to an attitude setpoint and joint torques. Pure.

A new law begins with a class of settings in `companion.config.controller` (also in `ControllerConfig` and in the lists below it). Its
gains are a file of `companion/config/files/controllers`; its equations are a module here, with a case in `factory`.
`vehicle_control` runs a law in every tick, `common` has what all laws share, `thrust` converts a force to attitude and thrust, and
`sensing` detects the catch. Estimates of unknown loads start at zero: `load_adaptation` (adaptive), `payload_mass` (psc) and
`disturbance` (any law).
"""
