"""From a mission file to the reference at every instant. Pure.

Durations, positions and speed limits of the phases are in the mission file (configs/missions), also for the flight after a catch:
the plan is made before take-off, and no phase reacts to a catch. `phase` is the interface of a type of phase (`companion.phases`), and
`air` what one with a state of its own sees in a tick. `plan` asks the phases for their motion; `plan_builder` builds the tracks and
chooses the profile of each move. `reference` defines the shape of a motion over time, `minsnap` plans paths and `arm_motion` plans the
arm's motion. `active_plan` stops and resumes the plan, and `retract` and `plan.landing_from` replace it. `sample_check` defines the
limits that a plan must respect.
"""
