"""The physics of the simulated world: `model` describes the bodies, `world` steps them in MuJoCo, and `plant` adds sensors, motors and
the autopilot. `effects` has the effects of a laboratory.
"""
