"""The committed JSON schemas are those of the models, and every committed YAML file fits."""

from __future__ import annotations

import json
import re
from functools import cache
from pathlib import Path
from typing import get_args

import jsonschema
import pytest

from companion.cli.schema import KINDS, schema_json
from companion.config.controller import PRESETS
from companion.config.shipped import names
from companion.config.yaml_strict import read_document
from companion.sitl_config.loader import WORLDS
from companion.sitl_config.world import World

CONFIGS = Path(__file__).parents[2] / "configs"
FOLDERS = {
    "missions": "mission",
    "vehicles": "vehicle",
    "controllers": "controller",
    "teams": "team",
    "worlds": "world",
}
FILES = [(path, kind) for folder, kind in FOLDERS.items() for path in sorted((CONFIGS / folder).glob("*.yaml"))]


@cache
def validator(kind: str) -> jsonschema.Draft202012Validator:
    return jsonschema.Draft202012Validator(json.loads(schema_json(kind)))


@pytest.mark.parametrize("kind", KINDS)
def test_committed_schema_is_up_to_date(kind: str) -> None:
    committed = (CONFIGS / "schema" / f"{kind}.schema.json").read_text(encoding="utf-8")
    assert committed == schema_json(kind) + "\n", (
        f"write the output of `companion schema {kind}` to configs/schema/{kind}.schema.json"
    )


def test_there_are_files_of_every_kind() -> None:
    assert {kind for _, kind in FILES} == set(FOLDERS.values())


@pytest.mark.parametrize(("path", "kind"), FILES, ids=[path.name for path, _ in FILES])
def test_committed_file_fits_its_schema_and_names_it(path: Path, kind: str) -> None:
    validator(kind).validate(read_document(path).data)
    header = re.match(r"# yaml-language-server: \$schema=(\S+)\n", path.read_text(encoding="utf-8"))
    assert header is not None
    assert (path.parent / header[1]).resolve() == (CONFIGS / "schema" / f"{kind}.schema.json").resolve()


def test_every_preset_is_shipped() -> None:
    presets = {f"{law}_{preset}" for law, presets in PRESETS.items() for preset in presets}
    assert set(names("controllers")) == presets


def test_every_world_is_shipped() -> None:
    assert WORLDS == ("careless", "ideal", "lab", "pair", "robustness", "wall")
    assert set(get_args(get_args(World.model_fields["extends"].annotation)[0])) == set(WORLDS)
