"""Phases in which the tool touches a surface. They share one contact: its state lasts from the approach until the vehicle is back.

`base` defines what they have in common, `machine` the state and when it changes, `way` the way to the surface, `force` the push and the
moves, `points` how points of a surface are touched, `surface` the plane through them, `sliding` the force along it, and `checks`
what is checked before take-off.
"""
