"""Preflight: observe the open devices for a few seconds, evaluate what they delivered with pure functions, and report one row per
check.
"""
