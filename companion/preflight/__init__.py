"""Preflight: observe the open devices for a few seconds, evaluate their data with pure functions, and report one row per
check.
"""
