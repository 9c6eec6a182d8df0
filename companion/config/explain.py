"""Converts Pydantic's errors to one message per problem, with origin, key, expected value, value found and a suggestion.

The expected values and the known keys are read from the model's own JSON Schema, so that they cannot differ from the checks.
"""

from __future__ import annotations

import difflib
import functools
import json
import re
from collections.abc import Iterator
from typing import Any, TypeVar, cast

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from companion.config.base import Location, Model
from companion.config.document import RANK_KEY, RANK_MISSING, RANK_VALUE, Data, Document, Origin, Problem, key_path
from companion.model.units import UNITS, split_unit

M = TypeVar("M", bound=Model)
_Node = dict[str, Any]

_UNITS = {
    **UNITS,
    "cm": "cm", "km": "km", "ft": "ft", "feet": "ft", "in": "in", "inch": "in", "min": "min", "sec": "s", "seconds": "s", "h": "h",
    "degrees": "deg", "radians": "rad", "rpm": "rpm", "mm_s": "mm/s", "cm_s": "cm/s", "km_h": "km/h", "kmh": "km/h", "mps": "m/s",
    "mph": "mph", "ft_s": "ft/s", "g": "g", "lb": "lb", "lbs": "lb", "kn": "kN", "lbf": "lbf", "kgf": "kgf", "khz": "kHz",
    "ma": "mA", "mv": "mV",
}  # fmt: skip
"""Units by key suffix, including units that no key uses."""
_KINDS = {"phases": "mission", "airframe": "vehicle", "law": "controller", "members": "team", "extends": "world"}
"""Kind of the file that has a key at its top level; no two kinds share one of these keys."""
MANY_OPTIONS = 12
"""Largest number of options that a message lists in full."""


@functools.cache
def schema_of(model: type[Model]) -> _Node:
    """Return the model's JSON Schema. It is cached, because generating it takes longer than the rest of the validation."""
    return model.model_json_schema()


def validate(model: type[M], document: Document) -> M | None:
    """Build a model from a document. If there are problems, append them to `document.problems` and return None."""
    built, error = _built(model, document)
    found = [] if error is None and not _has_booleans(document.data) else _found(model, document, error)
    reported = {(problem.origin, problem.text.split(": ")[0]) for problem in document.problems}
    document.problems += [problem for problem in found if (problem.origin, problem.text.split(": ")[0]) not in reported]
    return None if document.problems else built


def _built(model: type[M], document: Document) -> tuple[M | None, ValidationError | None]:
    try:
        return model.model_validate_json(json.dumps(document.data), strict=True), None
    except ValidationError as error:
        return None, error


def _has_booleans(data: Data) -> bool:
    if isinstance(data, dict):
        return any(map(_has_booleans, data.values()))
    return any(map(_has_booleans, data)) if isinstance(data, list) else isinstance(data, bool)


def _found(model: type[Model], document: Document, error: ValidationError | None) -> list[Problem]:
    """Return the problems of a document. This needs the schema: a document without problems does not wait for it."""
    schema = schema_of(model)
    found = [
        # In JSON `true` equals the constant 1.
        problem(RANK_VALUE, document.origin(at), at, f"expected {describe(node, schema)}, got {_show(value)}")
        for at, node, value in values(schema, document.data)
        if isinstance(value, bool) and node is not None and ("const" in node or "enum" in node)
    ]
    return found + ([] if error is None else _problems(error, schema, document))


def _problems(error: ValidationError, schema: _Node, document: Document) -> list[Problem]:
    problems: list[Problem] = []
    meant: set[Location] = set()
    listed: set[Location] = set()
    kind = another_kind(schema, document)
    if kind is not None:
        return [Problem(RANK_KEY, Origin(document.source), kind)]
    reported: set[Location] = set()
    missing: list[tuple[Location, str]] = []
    for detail in error.errors(include_url=False):
        at, node, parent = _walk(schema, detail["loc"])
        if detail["type"] == "extra_forbidden":
            text, instead = _unknown(at, parent, document, listed)
            problems.append(problem(RANK_KEY, document.key_origin(at), at, text))
            if instead is not None:
                meant.add((*at[:-1], instead))
            continue
        if detail["type"] == "missing":
            if isinstance(at[-1], int):  # a list that is too short is one problem of the list
                at, node, _ = _walk(schema, detail["loc"][:-1])
            else:
                _, parent, _ = _walk(schema, detail["loc"][:-1])
                options = (parent or {}).get("properties", {}).get(at[-1], {}).get("anyOf", ())
                or_null = ", or null if there is none" if {"type": "null"} in options else ""
                missing.append((at, describe(node, schema) + or_null))
                continue
        if detail["type"] == "too_short" and any(known[: len(at)] == at for known in reported):
            continue  # Pydantic counts the valid items only
        if at not in reported:
            reported.add(at)
            problems.append(_value_problem(detail, at, node, schema, document))
    for at, expected in missing:
        if at not in meant:
            problems.append(problem(RANK_MISSING, document.origin(at[:-1]), at, f"missing; expected {expected}"))
    return problems


def _value_problem(
    detail: ErrorDetails, at: Location, node: _Node | None, schema: _Node, document: Document
) -> Problem:
    kind = detail["type"]
    context = detail.get("ctx", {})
    if kind in ("condition", "value_error"):
        text = context["text"] if kind == "condition" else str(context["error"])
        return problem(RANK_VALUE, document.origin(at), at, text)
    if kind in ("union_tag_invalid", "union_tag_not_found") and node is not None:
        tags = list(node["discriminator"]["mapping"])
        at = (*at, node["discriminator"]["propertyName"])
        expected = f"one of {', '.join(tags)}"
        if kind == "union_tag_not_found":
            return problem(RANK_MISSING, document.origin(at), at, f"missing; expected {expected}")
        value = document.find(at)
        text = f"expected {expected}, got {_show(value)}{did_you_mean(str(value), tags)}"
        return problem(RANK_VALUE, document.origin(at), at, text)
    value = document.find(at)
    expected = describe(node, schema) if node is not None else str(detail["msg"])
    return problem(RANK_VALUE, document.origin(at), at, f"expected {expected}, got {_show(value)}{_hint(value, node)}")


def problem(rank: int, origin: Origin, at: Location, text: str) -> Problem:
    """Return a problem with the value at a location; its text omits the key if the command-line option already names it."""
    key = key_path(at)
    if not key or (not origin.line and origin.source.endswith(f".{key}")):
        return Problem(rank, origin, text)
    return Problem(rank, origin, f"{key}: {text}")


def describe(node: _Node | None, schema: _Node) -> str:
    """Return a description of the values that a node of a JSON Schema accepts."""
    node = _resolve(node or {}, schema)
    if "const" in node:
        return _show(node["const"])
    if "enum" in node:
        shown = [_show(option) for option in node["enum"]]
        if len(shown) > MANY_OPTIONS:
            return f"one of {len(shown)} names ({', '.join(shown[:3])}, ...)"
        return "one of " + ", ".join(shown)
    kind = node.get("type")
    if kind in ("number", "integer"):
        return ("a number" if kind == "number" else "a whole number") + _bounds(node)
    if kind == "array":
        if "prefixItems" in node:
            items = [describe(item, schema) for item in node["prefixItems"]]
            alike = len(set(items)) == 1
            return f"a list of {len(items)} {_plural(items[0]) if alike else 'values'}"
        least, most = node.get("minItems", 0), node.get("maxItems")
        each = _plural(describe(node.get("items"), schema))
        if most is not None and each.startswith("numbers"):
            return f"a list of {least} to {most} {each}"
        return f"a list of at least {least} items" if least else "a list"
    if kind == "object":
        keys = node.get("properties", {})
        return f"a mapping with the keys {', '.join(keys)}" if keys else "a mapping"
    if "discriminator" in node:
        return f"a mapping with '{node['discriminator']['propertyName']}'"
    return {"string": "text", "boolean": "true or false"}.get(str(kind), "another value")


def nearest(word: str, known: list[str]) -> str | None:
    """Return the known word most similar to `word`, or None if none is similar."""
    by_lower = {name.lower(): name for name in known}
    close = difflib.get_close_matches(word.lower(), by_lower, n=1, cutoff=0.6)
    return by_lower[close[0]] if close else None


def _bounds(node: _Node) -> str:
    low, high = node.get("minimum"), node.get("maximum")
    above, below = node.get("exclusiveMinimum"), node.get("exclusiveMaximum")
    if low is not None and high is not None:
        return f" from {low:g} to {high:g}"
    parts = [(">", above), (">=", low), ("<", below), ("<=", high)]
    bounds = " and ".join(f"{sign} {bound:g}" for sign, bound in parts if bound is not None)
    return f" {bounds}" if bounds else ""


def _plural(item: str) -> str:
    return re.sub(r"^(?:a|an) ((?:whole )?number)", r"\1s", item)


def another_kind(schema: _Node, document: Document) -> str | None:
    """Return the message about a file of another kind than expected, or None."""
    known = schema.get("properties", {})
    marks = [key for key in _KINDS if key in known]
    found = [key for key in _KINDS if key in document.data and key not in known]
    if not marks or not found or marks[0] in document.data:
        return None
    return f"is a {_KINDS[found[0]]} file, expected a {_KINDS[marks[0]]} file"


def _unknown(at: Location, parent: _Node | None, document: Document, listed: set[Location]) -> tuple[str, str | None]:
    """Return the message about an unknown key, and the known key that was probably meant or None.

    Args:
        listed: locations of the mappings whose known keys an earlier message has listed.
    """
    key = str(at[-1])
    known = list((parent or {}).get("properties", {}))
    stem, unit = split_unit(key, _UNITS)
    for candidate in known:
        candidate_stem, candidate_unit = split_unit(candidate, _UNITS)
        if candidate_unit is not None and candidate_stem == stem and candidate != key:
            here = f", in {_UNITS[candidate_unit]}"
            what = f"not in {_UNITS[unit]}" if unit is not None else "without a unit"
            return f"unknown key; write {candidate}{here} ({what})", candidate
    parts = [name for name in known if key.lower() in name.split("_")]
    close = nearest(key, known) or (parts[0] if len(parts) == 1 else None)
    if close is not None:
        return f"unknown key; did you mean {close}?", close
    if at[:-1] in listed:
        return "unknown key", None
    listed.add(at[:-1])
    given = document.find(at[:-1])
    in_file = document.key_origin(at).line > 0  # an override may name a key that the file has
    free = [name for name in known if not (in_file and isinstance(given, dict) and name in given)]
    return f"unknown key; known keys: {', '.join(free or known)}", None


def _hint(value: Data, node: _Node | None) -> str:
    """Return a suggestion for correcting a value of the wrong type, or an empty string."""
    wanted = node or {}
    options = wanted.get("enum", [])
    if options:
        if not isinstance(value, str) and any(isinstance(option, str) and option == str(value) for option in options):
            return " (put it in quotes)"
        return did_you_mean(value, [str(option) for option in options]) if isinstance(value, str) else ""
    if isinstance(value, str) and wanted.get("type") in ("number", "integer"):
        if re.fullmatch(r"\s*[-+]?[0-9]+,[0-9]+\s*", value):
            return f" (write {value.strip().replace(',', '.')})"
        number = re.match(r"\s*([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*([^\s0-9]*)", value)
        if number and number[2]:
            return f" (write {number[1]}; the key's name contains the unit)"
        if number:
            return f" (write {number[1]} without quotes)"
    return ""


def did_you_mean(word: str, options: list[str]) -> str:
    """Return a suggestion of the option most similar to `word`, in brackets after a space, or an empty string."""
    close = nearest(word, options)
    return f" (did you mean {close}?)" if close else ""


def _show(value: object) -> str:
    """Return a value in YAML notation, shortened to at most 60 characters."""
    if isinstance(value, float) and value != value:
        return ".nan"
    if isinstance(value, float) and value in (float("inf"), float("-inf")):
        return ".inf" if value > 0 else "-.inf"
    if value is None:
        return "nothing"
    if isinstance(value, dict):
        return "a mapping"
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else text[:57] + "..."


def _resolve(node: _Node, schema: _Node) -> _Node:
    """Return the node with references followed and, for an optional value, the alternative that is not null."""
    while True:
        if "$ref" in node:
            node = schema["$defs"][node["$ref"].rsplit("/", 1)[-1]]
        elif "anyOf" in node:
            node = next(option for option in node["anyOf"] if option.get("type") != "null")
        else:
            return node


def _step(node: _Node, step: str | int) -> _Node | None:
    if isinstance(step, str):
        other = node.get("additionalProperties")
        return cast("_Node | None", node.get("properties", {}).get(step, other if isinstance(other, dict) else None))
    prefix = node.get("prefixItems", [])
    return prefix[step] if step < len(prefix) else node.get("items")


def _walk(schema: _Node, loc: tuple[str | int, ...]) -> tuple[Location, _Node | None, _Node | None]:
    """Return the location in the document for Pydantic's (which has union tags too), and the schema nodes of value and parent."""
    node: _Node | None = _resolve(schema, schema)
    parent: _Node | None = None
    at: list[str | int] = []
    for step in loc:
        tags = (node or {}).get("discriminator", {}).get("mapping", {})
        if step in tags:
            node = _resolve({"$ref": tags[step]}, schema)
            continue
        parent = node
        node = _step(node, step) if node is not None else None
        node = _resolve(node, schema) if node is not None else None
        at.append(step)
    return tuple(at), node, parent


def values(
    node: _Node | None, data: Data, at: Location = (), root: _Node | None = None
) -> Iterator[tuple[Location, _Node | None, Data]]:
    """Yield (location, schema node, value) for every value of a document; a container comes before its contents.

    Args:
        node: schema node of the data; None for data that the schema does not know.
        root: the whole schema; None if `node` is the whole schema.
    """
    root = root if root is not None else node or {}
    node = _resolve(node, root) if node is not None else None
    if node is not None and "discriminator" in node and isinstance(data, dict):
        tag = data.get(node["discriminator"]["propertyName"])
        reference = node["discriminator"]["mapping"].get(tag) if isinstance(tag, str) else None
        node = _resolve({"$ref": reference}, root) if reference else None
    yield at, node, data
    children: Iterator[tuple[str | int, Data]]
    if isinstance(data, dict):
        children = iter(data.items())
    elif isinstance(data, list):
        children = iter(enumerate(data))
    else:
        return
    for step, child in children:
        yield from values(_step(node, step) if node is not None else None, child, (*at, step), root)
