"""The arm's servos: their control table and serial port (`registers`), the blocking communication (`bus`) and the driver (`arm`).

A new value that the servos measure is added to `BLOCK`, `_BLOCK` and `Block` of `registers`, is converted in `arm`, and needs a field
in `companion.model.types.ArmState`.
"""
