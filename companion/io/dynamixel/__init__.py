"""The arm's servos: their control table and serial port (`registers`), the blocking communication (`bus`) and the driver (`arm`).

To add a value that the servos measure, add it to `BLOCK`, `_BLOCK` and `Block` of `registers`, convert it in `arm`, and add a field to
`companion.model.types.ArmState`.
"""
