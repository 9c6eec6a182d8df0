"""The arm's servos: control table (`registers`), serial port (`port`), blocking communication (`bus`) and driver (`arm`).

To add a value that the servos measure, add it to `BLOCK`, `_BLOCK` and `Block` of `registers`, convert it in `arm`, and add a field to
`companion.model.types.ArmState`.
"""
