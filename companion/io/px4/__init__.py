"""PX4 through MAVSDK, on a link of our own. `driver` implements `companion.io.protocols.Autopilot` with the other modules: `wire`
transports bytes, `frames` and `messages` convert them, `link` and `claim` open the link, `inbox` keeps telemetry, `requests` paces
commands, `setpoints` sends attitude setpoints and `params` accesses parameters.
"""
