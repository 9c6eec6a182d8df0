"""Rules that detect faults, the ladder of safety states, and the limits on references and commands. Pure.

To add a rule, add a row to `rules`, with its actions and the text for the operator, and a predicate to the module of its subject:
`mocap`, `vision` (if another program feeds PX4), `px4` (also the battery), `arm` (also the force sensor), `flight` (also room and
tether) or `process` (also the operator's commands). Its threshold, with the default, becomes a key of
`companion.config.safety.Safety`; its test is a fault in tests/safety/faults.py. `notices` contains the events that have no
rule.

What the flight does when the state escalates is in `companion.core.reactions`, and what is sent while PX4 lands in
`autopilot_landing`. `governor` limits the reference, `gate` every setpoint and torque, and `rotor_stop` decides when the rotors may
stop.
"""
