"""Strict JSON from the network: rejects ambiguous data, which two parsers may read differently, and numbers out of range."""

from __future__ import annotations

import json
import math
from typing import Any

NUMBER_MAX = 1e12
"""Largest magnitude of a number in a message, far above any wall clock in seconds or flight clock in milliseconds."""
_NUMBER_CHARACTERS_MAX = 40


class StrictJsonError(ValueError):
    """The payload is not valid strict JSON. The exception's text is one line."""


def parse(payload: bytes) -> Any:
    """Return the data of a payload.

    Raises:
        StrictJsonError: the payload is not UTF-8 or not JSON, is nested too deeply, repeats a field name, or contains a number that
            is non-finite or exceeds `NUMBER_MAX` in magnitude.
    """
    try:
        text = payload.decode("utf-8")
        return json.loads(
            text, parse_int=_int, parse_float=_float, parse_constant=_constant, object_pairs_hook=_unique_fields
        )
    except StrictJsonError:
        raise
    except ValueError:
        raise StrictJsonError("not JSON") from None
    except RecursionError:
        raise StrictJsonError("nested too deeply") from None


def _int(text: str) -> int:
    value = int(text) if len(text) <= _NUMBER_CHARACTERS_MAX else math.inf
    if not -NUMBER_MAX <= value <= NUMBER_MAX:
        raise StrictJsonError(f"a number exceeds {NUMBER_MAX:g} in magnitude")
    return int(value)


def _float(text: str) -> float:
    value = float(text)
    if not -NUMBER_MAX <= value <= NUMBER_MAX:
        raise StrictJsonError(f"a number exceeds {NUMBER_MAX:g} in magnitude")
    return value


def _constant(text: str) -> float:
    raise StrictJsonError(f"a number is {text}, expected a finite one")


def _unique_fields(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    data = dict(pairs)
    if len(data) != len(pairs):
        raise StrictJsonError("a field name is repeated")
    return data
