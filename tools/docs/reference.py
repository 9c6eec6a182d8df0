"""Generates the pages of docs/internals/reference/ from the JSON Schemas of the configuration models.

`python -m tools.docs.reference docs/internals/reference` writes them.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from companion.cli.schema import KINDS, Described
from companion.model.units import unit_of

Schema = dict[str, Any]
_INTRO = {
    "mission": "One flight: start pose of the vehicle, motion limits, and phases in order. [Mission files](../../missions.md) explains "
    "the phases.",
    "vehicle": "One vehicle: masses and dimensions, devices, tether, room and limits. [Safety](../safety.md) explains the limits of "
    "`safety`.",
    "controller": "One control law with its gains; `law` names the law. [The control law](../control-law.md) describes the "
    "implementation.",
    "team": "Two vehicles that carry a bar: the mission of both, and what each has of its own.",
    "world": "True parameters of the simulated world, which the companion does not know. Give a file with `--world`, or keys with "
    "`--set world.KEY=VALUE`. Any number may be a distribution, `{uniform: [low, high]}` or `{normal: [mean, sigma]}`, from which the "
    "seed draws it. With examples: [the laboratory](../world.md), [the simulated world](../sitl.md#knobs).",
}


def page(kind: str) -> str:
    """Return the reference page of one kind of file.

    Raises:
        KeyError: the kind is not one of `KINDS`.
    """
    schema = KINDS[kind]().json_schema(schema_generator=Described)
    lines = [
        f"# The {kind} file: every key" if kind != "world" else "# The simulated world: every key",
        "",
        _INTRO[kind],
        "",
        "The name of a key contains its unit. `companion schema "
        + kind
        + "` prints the same information as a JSON Schema for",
        "editors. Conditions between keys are checked when the file is read; errors are reported with file, line and column.",
    ]
    definitions: dict[str, Schema] = schema.get("$defs", {})
    queue: list[tuple[str, Schema]] = list(_members("", schema, definitions)) if _choices(schema) else [("", schema)]
    while queue:
        path, model = queue.pop(0)
        inner = [
            below
            for key, value in model.get("properties", {}).items()
            for below in _members(f"{path}.{key}" if path and " " not in path else key, value, definitions)
        ]
        lines += ["", *_section(path, model, definitions)]
        queue[:0] = inner
    made = "Made by `python -m tools.docs.reference docs/internals/reference`; a test checks that this page agrees with the models."
    return "\n".join([*lines, "", made, ""])


def _choices(schema: Schema) -> list[Schema]:
    found: list[Schema] = schema.get("oneOf") or schema.get("anyOf") or []
    return found


def _members(path: str, value: Schema, definitions: dict[str, Schema]) -> Iterator[tuple[str, Schema]]:
    """Yield the records below a key, each once, with their paths."""
    seen: set[str] = set()
    for reference, suffix in _references(value):
        name = reference.rpartition("/")[2]
        model = definitions[name]
        if name in seen or model.get("type") != "object":
            continue
        seen.add(name)
        kind = _tag(model)
        yield (f"{path}{suffix}" + (f" {kind}" if kind else "")).strip(), model


def _references(value: Schema, suffix: str = "") -> Iterator[tuple[str, str]]:
    if "$ref" in value:
        yield value["$ref"], suffix
    for choice in _choices(value):
        yield from _references(choice, suffix)
    for item in [value["items"]] if isinstance(value.get("items"), dict) else value.get("prefixItems", []):
        yield from _references(item, suffix + "[]")


def _tag(model: Schema) -> str:
    """Return the word that distinguishes this record from its alternatives."""
    for key in ("type", "law"):
        word = model.get("properties", {}).get(key, {}).get("const")
        if word is not None:
            return str(word)
    return ""


def _section(path: str, model: Schema, definitions: dict[str, Schema]) -> list[str]:
    place, _, kind = path.partition(" ") if " " in path else (path, "", "")
    heading = f"{place}: {kind}" if kind else place or "Top level"
    wanted = set(model.get("required", ()))
    lines = [f"## {heading}", ""]
    if path and model.get("description"):
        lines += [_plain(model["description"], cell=False), ""]
    lines += ["| key | value | unit | range | default | meaning |", "|---|---|---|---|---|---|"]
    for key, value in model.get("properties", {}).items():
        default = "required" if key in wanted else _default(value)
        path_below = f"{place}.{key}" if place and not kind else key
        kinds = _type(value, definitions).replace("section", f"[section](#{_anchor(path_below)})")
        cells = [f"`{key}`", kinds, unit_of(key) or "", _range(value), default, _meaning(value)]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _anchor(heading: str) -> str:
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def _meaning(value: Schema) -> str:
    return _plain(value.get("description", ""), cell=True)


def _plain(text: str, *, cell: bool) -> str:
    text = " ".join(text.split()) if cell else "\n".join(line.strip() for line in text.strip().splitlines())
    return text.replace("|", "\\|") if cell else text


def _default(value: Schema) -> str:
    default = value.get("default")
    if default is None:
        return "absent"
    return "those below" if isinstance(default, dict) and default else f"`{json.dumps(default)}`"


def _type(value: Schema, definitions: dict[str, Schema]) -> str:
    if "$ref" in value:
        model = definitions[value["$ref"].rpartition("/")[2]]
        return _tag(model) or ("section" if model.get("type") == "object" else _type(model, definitions))
    if "const" in value:
        return f"`{value['const']}`"
    if "enum" in value:
        return ", ".join(f"`{one}`" for one in value["enum"])
    if _choices(value):
        return " or ".join(dict.fromkeys(_type(choice, definitions) for choice in _choices(value)))
    if value.get("type") == "array":
        items = value.get("prefixItems")
        if items:
            kinds = list(dict.fromkeys(_type(item, definitions) for item in items))
            return f"{len(items)} x {' / '.join(kinds)}"
        return f"list of {_type(value['items'], definitions)}"
    if value.get("type") == "object":
        return f"names with {_type(value.get('additionalProperties', {}), definitions)}"
    words = {"number": "number", "integer": "integer", "boolean": "`true`, `false`", "string": "text", "null": "`null`"}
    return words.get(value.get("type", ""), "any")


def _range(value: Schema) -> str:
    """Return the bounds of a value, or the common bounds of its components."""
    for choice in _choices(value):
        if choice.get("type") != "null":
            return _range(choice)
    items = value.get("prefixItems", [])
    if items:
        ranges = [_range(item) for item in items]
        return ranges[0] if len(set(ranges)) == 1 else "; ".join(ranges)
    parts = []
    for key, sign in (("exclusiveMinimum", ">"), ("minimum", ">="), ("exclusiveMaximum", "<"), ("maximum", "<=")):
        if key in value:
            parts.append(f"{sign} {value[key]:g}" if abs(value[key]) < 1e6 else f"{sign} {value[key]}")
    if "multipleOf" in value:
        parts.append(f"a multiple of {value['multipleOf']:g}")
    what = {"Length": "characters", "Items": "of them"}
    for end, word in what.items():
        low, high = value.get(f"min{end}"), value.get(f"max{end}")
        if low is not None or high is not None:
            parts.append(f"{low or 0} to {high} {word}" if high is not None else f"{low} {word} or more")
    return ", ".join(parts)


def write(folder: Path) -> None:
    """Write every page into the folder.

    Raises:
        OSError: a page cannot be written.
    """
    for kind in KINDS:
        (folder / f"{kind}.md").write_text(page(kind), encoding="utf-8")


def main(arguments: list[str]) -> int:
    """Write the pages and return the exit code; print the reason for a failure on standard error."""
    if len(arguments) != 1:
        print("expected one folder: python -m tools.docs.reference docs/internals/reference", file=sys.stderr)
        return 2
    try:
        write(Path(arguments[0]))
    except OSError as error:
        print(f"{arguments[0]}: cannot be written: {error.strerror}; give an existing folder", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
