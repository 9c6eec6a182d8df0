"""Writes the example files for the mosquitto broker: `python -m tools.docs.mosquitto configs/mosquitto`."""

from __future__ import annotations

import sys
from pathlib import Path

from companion.ground.broker.mosquitto_config import INSTALLED, acl_text, profile_text


def example_files() -> dict[str, str]:
    """Return the texts of the example files in `configs/mosquitto/` by file name."""
    return {
        "secure.conf": profile_text(INSTALLED),
        "acl": acl_text(["tarot650-2r"], ["operator"], ["viewer"]),
    }


if __name__ == "__main__":
    for file_name, file_text in example_files().items():
        (Path(sys.argv[1]) / file_name).write_text(file_text, encoding="utf-8")
