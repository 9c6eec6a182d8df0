"""Writes values as YAML text on one line, for files that a user continues to edit."""

from __future__ import annotations

import json
import math
import re
from typing import Any

import yaml

from companion.config.document import Origin
from companion.config.yaml_strict import parse_value

_PLAIN = re.compile(r"[A-Za-z0-9_./][A-Za-z0-9_./+-]*(?::[A-Za-z0-9_./+-]+)*")


def flow_text(value: Any) -> str:
    """Return a value as one line of YAML in flow style, which `parse_value` reads back unchanged.

    Args:
        value: None, bool, int, float, str, or lists, tuples and dicts of them. A string that is not a plain word is quoted, and every
            character that YAML would fold, break or strip is escaped.
    """
    if isinstance(value, dict):
        return "{" + ", ".join(f"{flow_text(key)}: {flow_text(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(flow_text, value)) + "]"
    if not isinstance(value, str):
        return json.dumps(value)
    if _PLAIN.fullmatch(value) and parse_value(value, Origin("")) == value:
        return value
    quoted: str = yaml.dump(str(value), default_style='"', allow_unicode=True, width=math.inf)
    return quoted.removesuffix("\n")
