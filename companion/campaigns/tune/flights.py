"""Flies the flights of a search in batches, and keeps the result of each in a file, so that an interrupted search goes on."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Sequence
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any, Self

from companion.campaigns.process import CampaignProcess, Message
from companion.campaigns.runner import INTERRUPTS, Row, progress_bar
from companion.config.document import ConfigError
from companion.runtime.files import write_whole
from companion.runtime.subprocesses import signals_call

FILE = "flights.jsonl"
"""Name of the file in the folder of results: a line with the settings of the search, then one for each flight."""


class Interrupted(Exception):
    """The operator ended the search."""


class Flights(AbstractContextManager["Flights"]):
    """Flights of one search. A flight that the file has already is not flown again.

    Args:
        folder: folder of results; None to keep nothing.
        settings: what the result of a flight depends on, besides the flight.
        total: number of flights of the whole search, for the progress bar.

    Raises:
        ConfigError: the folder holds another search.
    """

    def __init__(self, job: Message, folder: Path | None, settings: dict[str, Any], total: int, log: Path) -> None:
        self._job, self._log = job, log
        self._path = folder / FILE if folder is not None else None
        self._known: dict[str, Row] = {}
        self._stack = ExitStack()
        self._process: CampaignProcess | None = None
        self._stopped = False
        self._bar = progress_bar()
        self._task = self._bar.add_task("", total=total)
        self.flown: list[Message] = []
        if self._path is not None:
            self._open(self._path, settings)

    def __enter__(self) -> Self:
        self._stack.enter_context(signals_call(INTERRUPTS, self._stop))
        self._stack.enter_context(self._bar)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def fly(self, flights: Sequence[Message], about: str) -> list[Row]:
        """Return the rows of the flights, in their order.

        Args:
            flights: flights in the format of `sitl.campaigns.tune`.

        Raises:
            CampaignError: the flights cannot be flown.
            Interrupted: the operator ended the search.
        """
        keys = [_key(flight) for flight in flights]
        missing = {key: flight for key, flight in zip(keys, flights, strict=True) if key not in self._known}
        self._bar.update(self._task, advance=len(flights) - len(missing), description=about)
        if missing and not self._stopped:
            self._fly_missing(missing)
        if self._stopped:
            raise Interrupted
        return [self._known[key] for key in keys]

    def _fly_missing(self, missing: dict[str, Message]) -> None:
        if self._process is None:
            self._process = self._stack.enter_context(CampaignProcess(self._job, self._log))
        keys = list(missing)
        with open(self._path, "a", encoding="utf-8") if self._path else contextlib.nullcontext() as file:
            for message in self._process.fly([missing[key] for key in keys]):
                key = keys[message["index"]]
                self._known[key] = message["row"]
                self.flown.append(message)
                if file is not None:
                    file.write(json.dumps({"flight": key, "row": message["row"]}) + "\n")
                    file.flush()
                self._bar.update(self._task, advance=1)

    def _stop(self) -> None:
        self._stopped = True
        if self._process is not None:
            self._process.ask_to_stop()

    def _open(self, path: Path, settings: dict[str, Any]) -> None:
        """Read what was flown before, or begin a new file. A line that was cut short by the end of the program is dropped."""
        wanted = json.loads(json.dumps(settings))
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []
        begun, *known = [data for line in lines if (data := _parsed(line)) is not None] or [wanted]
        for key in sorted(begun.keys() | wanted.keys()):
            if begun.get(key) != wanted.get(key):
                raise ConfigError(
                    f"companion tune: --out {path.parent}: holds another search: {key} was {_short(begun.get(key))}, "
                    f"is {_short(wanted.get(key))}; choose another folder"
                )
        self._known = {line["flight"]: line["row"] for line in known if "row" in line}
        write_whole(path, "".join(json.dumps(line) + "\n" for line in (begun, *known)).encode())


def _key(flight: Message) -> str:
    """Return a name for a flight that is the same for the same flight only."""
    return hashlib.sha256(json.dumps(flight, sort_keys=True).encode()).hexdigest()[:24]


def _parsed(line: str) -> dict[str, Any] | None:
    try:
        data = json.loads(line)
    except ValueError:
        return None
    return data if isinstance(data, dict) else None


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
