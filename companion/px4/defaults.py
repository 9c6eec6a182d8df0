"""Parameters of the simulated PX4: names, types (int for INT32, float for REAL32) and the defaults of PX4 1.16, from `defaults.json`.

The airframe and calibration parameters have the values of a quadrotor that has been set up. The names in `world.px4_params` are checked
against this table if the stub flies.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from companion.model.rotors import ROTORS_MAX

PX4_DEFAULTS: Mapping[str, float | int] = {
    **json.loads(Path(__file__).with_name("defaults.json").read_text(encoding="utf-8")),
    **{
        f"CA_ROTOR{index}_{key}": value
        for index in range(ROTORS_MAX)
        for key, value in (("PX", 0.0), ("PY", 0.0), ("PZ", 0.0), ("KM", 0.05))
    },
}
