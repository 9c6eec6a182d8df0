"""Writes the JSON Schemas of the telemetry messages, one per topic, to docs/internals/telemetry: `python -m tools.docs.telemetry`."""

from __future__ import annotations

import inspect
import json
import sys
from pathlib import Path
from typing import Any

from companion.ground.protocol.messages import RECORDS, Topic
from companion.model.codec import json_schema

FOLDER = Path(__file__).parents[2] / "docs/internals/telemetry"


def schema_of(topic: Topic) -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of the messages on a topic."""
    cls = RECORDS[topic]
    return {**json_schema(cls), "description": (inspect.getdoc(cls) or "").splitlines()[0]}


def schema_text(topic: Topic) -> str:
    """Return the content of a topic's schema file."""
    return json.dumps(schema_of(topic), indent=2, ensure_ascii=False) + "\n"


def schema_file(topic: Topic, folder: Path = FOLDER) -> Path:
    """Return the path of a topic's schema file."""
    return folder / f"{topic.value}.schema.json"


def main() -> int:
    """Write all schema files; return the exit code."""
    try:
        FOLDER.mkdir(exist_ok=True)
        for topic in Topic:
            schema_file(topic).write_text(schema_text(topic), encoding="utf-8")
    except OSError as error:
        print(f"{error.filename}: {error.strerror}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
