"""Preflight: observe the open devices for a few seconds, evaluate their data with pure functions, and report one row per check.

A new check is a `Check` in the module of its subject: add it to that module's `CHECKS`, and make its row in `rows` there. The module of
a new subject is added to `CHECKS` and `rows` of `evaluation`.
"""
