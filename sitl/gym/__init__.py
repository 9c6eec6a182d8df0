"""Gymnasium environments over the fast loop: import this package, then `gymnasium.make("companion/Catch-v0")`.

They are here and not in `companion`, because they run the simulated world, which the product does not import.
"""

from __future__ import annotations

import gymnasium

WORLDS = {"Catch": "lab", "Hover": "lab", "Press": "wall", "Intercept": "careless"}
"""Built-in world of each environment, whose mission has the same name in small letters; each extends the world `lab`."""

for _name, _world in WORLDS.items():
    gymnasium.register(
        f"companion/{_name}-v0",
        entry_point="sitl.gym.environment:FlightEnvironment",
        kwargs={"mission": _name.lower(), "world": _world},
    )
