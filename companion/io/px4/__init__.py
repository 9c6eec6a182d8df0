"""PX4 through MAVSDK. `driver` implements `companion.io.protocols.Autopilot` with the other modules: `link` opens the connection,
`inbox` receives telemetry, `requests` paces commands, `setpoints` sends attitude setpoints and `params` accesses parameters.
"""
