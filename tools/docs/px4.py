"""Generates the files of configs/px4/ and the table of docs/internals/px4.md from `companion.px4.required`.

`python -m tools.docs.px4 .` writes them, given the repository's root.
"""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path

from companion.preflight.px4 import text_of
from companion.px4 import params_file
from companion.px4.required import GROUPS, NO_RADIO, RADIO, file_values
from companion.px4.versions import varies, which
from tools.docs.tables import markdown, written

NO_RADIO_FILE = "no_radio.params"
DOCS_MARK = "parameters"

_WIDTH = 110


def indoor_mocap_text() -> str:
    """Return the text of configs/px4/indoor_mocap.params."""
    comments: dict[str, list[str]] = {}
    for title, group in GROUPS.items():
        inside = [wanted for wanted in group if wanted.file and wanted.value is not None]
        for index, wanted in enumerate(inside):
            above = ["", f"== {title} =="] if index == 0 else []
            reboot = " Takes effect after a reboot." if wanted.reboot else ""
            also = f" Accepted: {wanted.text()}." if wanted.ok or wanted.limits else ""
            only = f" PX4 {which(wanted.name)}." if varies(wanted.name) else ""
            comments[wanted.name] = above + textwrap.wrap(f"{wanted.name}: {wanted.why}.{also}{reboot}{only}", _WIDTH)
    heading = [
        "PX4 1.15 to 1.18, for a quadrotor that flies indoors on motion capture, without GPS.",
        "",
        "Load it in QGroundControl (Vehicle setup > Parameters > Tools > Load from file), or with",
        "companion px4 params --write, which writes only values that differ and saves the old values in a file.",
        "",
        f"Not included: MPC_THR_HOVER, which is measured on each vehicle, and {RADIO}, because {NO_RADIO} switches the",
        f"pilot's radio off ({NO_RADIO_FILE}, for vehicles without a radio).",
        "",
    ]
    return params_file.text(file_values(), heading, comments)


def no_radio_text() -> str:
    """Return the text of configs/px4/no_radio.params."""
    return params_file.text(
        {RADIO: NO_RADIO},
        ["Only for vehicles without a radio: with this value, PX4 ignores the sticks and the mode switch.", ""],
    )


def table_markdown() -> str:
    """Return the table of parameters for docs/internals/px4.md."""
    blocks = []
    for title, group in GROUPS.items():
        rows = []
        for wanted in group:
            value = "measured" if wanted.value is None else f"`{text_of(wanted.value)}`"
            if not wanted.file and wanted.value is not None:
                value += " without a radio"
            reboot = "yes" if wanted.reboot else ""
            name = f"`{wanted.name}` ({which(wanted.name)})" if varies(wanted.name) else f"`{wanted.name}`"
            rows.append((name, value, wanted.text(), wanted.level.value, reboot, wanted.why))
        head = ("parameter", "set", "accepted", "if not", "reboot", "reason")
        blocks.append(f"**{title}**\n\n{markdown(head, rows)}")
    return "\n\n".join(blocks)


def main(root: Path) -> None:
    """Write all files below `root`."""
    (root / "configs/px4/indoor_mocap.params").write_text(indoor_mocap_text(), encoding="utf-8")
    (root / "configs/px4" / NO_RADIO_FILE).write_text(no_radio_text(), encoding="utf-8")
    page = root / "docs/internals/px4.md"
    page.write_text(written(page.read_text(encoding="utf-8"), {DOCS_MARK: table_markdown()}), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
