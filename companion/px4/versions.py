"""Differences between PX4 1.15, 1.16, 1.17 and 1.18 that matter here: which of them has which parameter.

Read in the sources of 1.15.4, 1.16.1 and 1.17 (beta), and all four tried in the simulated world. A parameter that is not named
here is in all four. A development version may already be or still be without one of these, so none of them is required.
"""

from __future__ import annotations

from collections.abc import Mapping

Release = tuple[int, int]

OLDEST: Release = (1, 15)
"""Older versions have other parameters."""
KNOWN_GOOD: tuple[Release, ...] = ((1, 15), (1, 16), (1, 17), (1, 18))
"""Versions with which missions have been flown, in simulation."""
LAST: Mapping[str, Release] = {"COM_KILL_DISARM": (1, 17), "EKF2_GPS_DELAY": (1, 17), "SIM_BAT_ENABLE": (1, 17)}
"""The last version that has a parameter. In 1.18 SENS_GPS0_DELAY and SENS_GPS1_DELAY, and SIM_BAT_DRAIN 0, take their places."""
FIRST: Mapping[str, Release] = {"SENS_GPS0_DELAY": (1, 18), "SENS_GPS1_DELAY": (1, 18), "MC_REF_W_N": (1, 18)}


def has(name: str, release: Release) -> bool:
    """Return whether a release of PX4 has a parameter that others of them have."""
    return FIRST.get(name, release) <= release <= LAST.get(name, release)


def varies(name: str) -> bool:
    """Return whether only some versions have the parameter."""
    return name in FIRST or name in LAST


def which(name: str) -> str:
    """Return the versions that have the parameter, such as "up to 1.17"; empty if all have it."""
    if name in LAST:
        return "up to {}.{}".format(*LAST[name])
    return "from {}.{}".format(*FIRST[name]) if name in FIRST else ""
