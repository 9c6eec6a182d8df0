"""One control tick, and the stages of a flight. Pure.

`flight_core` defines the order of the steps in a tick. `sequence` defines the stages from waiting for inputs to disarming: what
each waits for, its timeout, and its requests to PX4. `reactions` defines what the flight does when the safety state escalates:
hold, retract, land, or leave the vehicle to a pilot who took over. Which event requests which state is in `companion.safety.rules`,
and what is sent while PX4 lands in `companion.safety.autopilot_landing`.
"""
