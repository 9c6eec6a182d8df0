"""What authors of control laws, phases and devices in packages of their own import: stable, and documented in docs/api.md.

A name that is not exported here may change without notice. `companion.testing` has the checks for their tests.
"""
