"""JSON from the network, read strictly: what two readers could understand differently, or no figure of a vehicle can be, is refused."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

from companion.model.codec import plain

NUMBER_MAX = 1e12
"""Magnitude of every number in a message, at most. Wall clocks in seconds and flight clocks in milliseconds are far below."""
_NUMBER_CHARACTERS_MAX = 40


class WireError(ValueError):
    """The payload is not JSON as it may be in a message; one line."""


def parse(payload: bytes) -> Any:
    """The data of a payload.

    Raises:
        WireError: it is not UTF-8 or not JSON, is nested too deeply, names a field twice, or holds a number that is not finite or
            beyond `NUMBER_MAX`.
    """
    try:
        text = payload.decode("utf-8")
        return json.loads(
            text, parse_int=_int, parse_float=_float, parse_constant=_constant, object_pairs_hook=_each_field_once
        )
    except WireError:
        raise
    except ValueError:
        raise WireError("no JSON") from None
    except RecursionError:
        raise WireError("nested too deeply") from None


def check_finite(record: object) -> None:
    """Refuse a record with a number that is not finite: the codec of logs reads the text "nan" as one.

    Raises:
        WireError: it has one.
    """
    if not _finite(plain(record)):
        raise WireError("a number is not finite")


def _finite(values: Sequence[Any]) -> bool:
    for value in values:
        if isinstance(value, float):
            if not math.isfinite(value):
                return False
        elif isinstance(value, (list, tuple)) and not _finite(value):
            return False
    return True


def _int(text: str) -> int:
    value = int(text) if len(text) <= _NUMBER_CHARACTERS_MAX else math.inf
    if not -NUMBER_MAX <= value <= NUMBER_MAX:
        raise WireError(f"a number is beyond {NUMBER_MAX:g}")
    return int(value)


def _float(text: str) -> float:
    value = float(text)
    if not -NUMBER_MAX <= value <= NUMBER_MAX:
        raise WireError(f"a number is beyond {NUMBER_MAX:g}")
    return value


def _constant(text: str) -> float:
    raise WireError(f"a number is {text}, expected a finite one")


def _each_field_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    data = dict(pairs)
    if len(data) != len(pairs):
        raise WireError("a field is there twice")
    return data
