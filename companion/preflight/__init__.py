"""Preflight: observe the open devices for a few seconds, evaluate their data with pure functions, and report one row per check.

To add a check, define a `Check` in the module of its subject, list it in that module's `CHECKS`, and return its row from that
module's `rows`. If the subject is new, also add its module to `CHECKS` and `rows` in `evaluation`.
"""
