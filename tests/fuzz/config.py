"""YAML: bytes, text and mutated configuration files through the loader. Either it is accepted, or `ConfigError` names file and line."""

from __future__ import annotations

import re
import shutil
import tempfile
from pathlib import Path
from random import Random
from typing import ClassVar, Self

from companion.config.document import ConfigError, Origin
from companion.config.loader import load_flight, load_vehicle
from companion.config.overrides import parse_overrides
from companion.config.yaml_strict import SIZE_MAX_BYTES, parse_value, read_document
from tests.fuzz.mutate import mutated
from tests.fuzz.target import Target, Wrong, one_line

_ROOT = Path(__file__).parents[2]
_MISSION = _ROOT / "configs/missions/catch.yaml"
_VEHICLE = _ROOT / "configs/vehicles/tarot650_2r.yaml"
_CONTROLLERS = sorted((_ROOT / "configs/controllers").glob("*.yaml"))
_MEMORY = Path("/dev/shm")
"""Folder for one file per input, in memory because a disk is too slow for a million of them."""
_READ, _VALUE, _OVERRIDE, _AS_VEHICLE, _AS_MISSION, _AS_CONTROLLER = range(6)
"""First byte of an input: how the rest is read."""
_LINE_MAX = 3000
_TOKENS = (
    "{", "}", "[", "]", ",", ":", ": ", "- ", "? ", "\n", "\n  ", "\t", "#", "|", ">", "|+2\n", "'", '"', '"\\U0011FFFF"',
    '"\\uD800"', '"\\x00"', "%YAML 1.2\n", "%YAML 1." + "9" * 5000 + "\n", "%TAG ! x\n", "---\n", "...\n", "&a ", "*a",
    "!!int ", "!<", "%C3", "<<: ", "~", "1e400", "-.inf", ".nan", "0x" + "F" * 300, "9" * 4500, "1_0", "0o9", "true", "on",
    "\x00", "\x85", "\u2028", "\ufeff", "\U0001F600", "\x1b[2J", "a" * 1100 + ": ",
)  # fmt: skip


class YamlTarget(Target):
    """Configuration text; the first byte of an input selects how the rest is read."""

    name: ClassVar[str] = "yaml"

    def __init__(self) -> None:
        self._folder = Path()
        self._small = _small_documents()
        self._files = {
            _AS_VEHICLE: [_VEHICLE.read_bytes()],
            _AS_MISSION: [path.read_bytes() for path in sorted(_MISSION.parent.glob("*.yaml"))],
            _AS_CONTROLLER: [path.read_bytes() for path in _CONTROLLERS],
        }

    def __enter__(self) -> Self:
        self._folder = Path(tempfile.mkdtemp(prefix="fuzz", dir=_MEMORY if _MEMORY.is_dir() else None))
        self._file = self._folder / "f.yaml"
        self._mission = self._folder / "mission.yaml"
        text = _MISSION.read_text(encoding="utf-8")
        controller = "controller:\n  file: f.yaml\n"
        self._mission.write_text(
            re.sub(r"^controller:.*\n( .*\n)*", "", text, flags=re.MULTILINE) + "\n" + controller, "utf-8"
        )
        return self

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self._folder)

    def make(self, rng: Random) -> bytes:
        kind = rng.random()
        if kind < 0.01:  # a whole file takes some fifty times as long as a few lines
            mode = rng.choice((_AS_VEHICLE, _AS_MISSION, _AS_CONTROLLER))
            return bytes((mode,)) + _damaged_text(rng, self._files[mode], SIZE_MAX_BYTES + 10)
        if kind < 0.13:
            return bytes((_OVERRIDE,)) + _damaged_text(rng, _OVERRIDES, 300)
        mode = _VALUE if kind < 0.3 else _READ
        return bytes((mode,)) + _damaged_text(rng, self._small, 400)

    def feed(self, data: bytes) -> None:
        if not data:
            return
        mode, content = data[0], data[1:]
        try:
            self._load(mode, content)
        except ConfigError as error:
            self._check_refusal(mode, error)
        if parse_value("[1, 2.5]", Origin("--set x")) != [1, 2.5]:
            raise Wrong("a valid value behind it is not understood")

    def _load(self, mode: int, content: bytes) -> None:
        if mode == _VALUE:
            parse_value(content.decode("utf-8", "replace"), Origin("--set x"))
        elif mode == _OVERRIDE:
            parse_overrides([content.decode("utf-8", "replace")])
        else:
            self._file.write_bytes(content)
            if mode == _READ:
                read_document(self._file, "f.yaml")
            elif mode == _AS_VEHICLE:
                load_vehicle(self._file).model_dump_json()
            elif mode == _AS_MISSION:
                load_flight(self._file, _VEHICLE).model_dump_json()
            else:
                load_flight(self._mission, _VEHICLE).model_dump_json()

    def _check_refusal(self, mode: int, error: ConfigError) -> None:
        if not error.lines:
            raise Wrong("a refusal without a reason")
        for line in error.lines:
            one_line(line, "a refusal")
            if len(line) > _LINE_MAX:
                raise Wrong(f"a refusal of {len(line)} characters: {line:.200}")
            known = ("--set ",) if mode in (_VALUE, _OVERRIDE) else ("f.yaml:", f"{self._file}", f"{self._mission}")
            if not line.startswith(known):
                raise Wrong(f"a refusal that does not say where: {line:.200}")


def _damaged_text(rng: Random, corpus: list[bytes], size_max: int) -> bytes:
    """Damage to bytes, or in two of three to text: tokens that mean something in YAML, lines moved, values swapped."""
    if rng.random() < 0.33:
        return mutated(rng, corpus, size_max)
    text = rng.choice(corpus).decode("utf-8", "replace")
    for _ in range(rng.randint(1, 4)):
        at = rng.randint(0, len(text))
        kind = rng.randrange(5)
        if kind == 0:
            text = text[:at] + rng.choice(_TOKENS) + text[at:]
        elif kind == 1:
            text = text[:at] + rng.choice(_TOKENS) * rng.choice((2, 3, 40)) + text[at:]
        elif kind == 2:
            lines = text.splitlines(keepends=True) or [""]
            lines.insert(rng.randint(0, len(lines)), " " * rng.randrange(5) + rng.choice(lines))
            text = "".join(lines)
        elif kind == 3:
            values = list(re.finditer(r"[-+.\w]+", text))
            if values:
                found = rng.choice(values)
                text = text[: found.start()] + rng.choice(_TOKENS) + text[found.end() :]
        else:
            text = text[:at] + text[at + rng.randint(1, 30) :]
    return text.encode("utf-8", "surrogatepass")[:size_max]


_OVERRIDES = [
    b"world.payload_kg=0.2",
    b"world.throw_velocity_m_s=[-2, 0.15, -1.5]",
    b"mission.phases[0].duration_s=3",
    b"vehicle.devices.mocap.server=10.0.0.2",
    b"controller.gains[2]={a: [1, b]}",
    b"world.faults=[{kind: mocap_loss, t_s: 3.0}]",
]


def _small_documents() -> list[bytes]:
    """Every file cut into blocks of three lines, and one document of each construct."""
    constructs = [
        b"a: 1\nb: {c: [1, -2.5e3, .nan], d: 'x'}\n",
        b"list:\n  - x: 1\n    y: [true, ~, 0x1F]\n  - |\n    text\n    more\n",
        b'"quoted \\u00e9": >-\n  folded\n  text\n? key\n: value\n',
        b"deep: " + b"[" * 30 + b"]" * 30 + b"\n",
        b"\xef\xbb\xbfa: 1 # with a BOM\r\nb: 2\r\n",
        b"- 1\n- 2\n",
        b"",
    ]
    blocks = []
    for path in (_VEHICLE, *sorted(_MISSION.parent.glob("*.yaml")), *_CONTROLLERS):
        lines = path.read_bytes().splitlines(keepends=True)
        blocks += [b"".join(lines[k : k + 3]) for k in range(0, len(lines), 3)]
    return [*constructs * 4, *blocks]
