"""Records of a log as tables with a column for each field, written piece by piece: an hour's would not fit into memory."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from typing import IO, Any, Final, TypeVar

import msgspec

from companion.analysis.flat import flat
from companion.model.outputs import Outputs, Sent
from companion.model.types import Inputs

TOPICS: Final = ("/inputs", "/outputs", "/sent")
_PIECE_ROWS: Final = 2000

TimedCells = tuple[float, dict[str, Any]]
"""Time of a row, s on the flight clock, and its cells by column name."""
Item = TypeVar("Item")


def pieces_of(rows: Iterable[Item]) -> Iterator[list[Item]]:
    """Iterate over rows in pieces that fit into memory."""
    left = iter(rows)
    while piece := list(islice(left, _PIECE_ROWS)):
        yield piece


def cells_of(record: Any) -> dict[str, Any]:
    """Return the values of a record and of the records in it, except `t_s` and `events`, keyed by column name."""
    fields = {key: value for key, value in msgspec.to_builtins(record).items() if key not in ("t_s", "events")}
    cells = flat(fields, lambda values: not all(isinstance(value, str) for value in values))
    return {
        name: ", ".join(value) if isinstance(value, list | tuple) else value for name, value in cells if value != {}
    }


@dataclass(slots=True)
class _Column:
    types: set[type] = field(default_factory=set)
    known: int = 0
    example: Any = None


class Table:
    """One table of a log. Its columns are known; its rows are read when they are needed.

    Args:
        rows: returns the rows from the first one on.
    """

    def __init__(self, rows: Callable[[], Iterable[TimedCells]]) -> None:
        self._rows = rows
        self._count = 0
        self._columns: dict[str, _Column] = {}

    def take(self, cells: dict[str, Any]) -> None:
        """Learn the columns from the cells of the next row."""
        self._count += 1
        for name, value in cells.items():
            column = self._columns.setdefault(name, _Column())
            if value is not None:
                column.types.add(type(value))
                column.known += 1
                column.example = value

    @property
    def columns(self) -> list[str]:
        """Names of the columns, in the order in which they appear in the log."""
        return list(self._columns)

    def write(self, file: IO[bytes], suffix: str) -> None:
        """Write the table as `csv` or `parquet`.

        Raises:
            ImportError: pyarrow is not installed, and the suffix is `parquet`.
            OSError: the file cannot be written.
        """
        pieces = (self._frame(rows) for rows in pieces_of(self._rows()))
        if suffix == "csv":
            file.write(self._frame(()).to_csv().encode())
            for piece in pieces:
                file.write(piece.to_csv(header=False).encode())
            return
        import pyarrow
        from pyarrow import parquet

        example = self._frame([(0.0, {name: column.example for name, column in self._columns.items()})])
        schema = pyarrow.Schema.from_pandas(example)
        with parquet.ParquetWriter(file, schema) as writer:
            for piece in pieces:
                writer.write_table(pyarrow.Table.from_pandas(piece, schema=schema))

    def _frame(self, rows: Sequence[TimedCells]) -> Any:
        import pandas

        times_s, cells = zip(*rows, strict=True) if rows else ((), ())
        index = pandas.Index(times_s, name="t_s", dtype=float)
        types = {name: self._type(column) for name, column in self._columns.items()}
        return pandas.DataFrame(list(cells), index=index, columns=list(types)).astype(types)

    def _type(self, column: _Column) -> str:
        """Return the type that pandas finds in the whole column."""
        complete = column.known == self._count
        if column.types == {bool}:
            return "bool" if complete else "object"
        if column.types == {int} and complete:
            return "int64"
        return "float64" if column.types and column.types <= {int, float} else "object"


def tables_of(every_tick: Callable[[], Iterable[tuple[Inputs, Outputs, Sent]]]) -> dict[str, Table]:
    """Return the tables of `FlightLog.to_pandas`.

    Args:
        every_tick: returns the ticks from the first one on.
    """

    def rows_of(place: int) -> Iterator[TimedCells]:
        for row in every_tick():
            yield row[0].t_s, cells_of(row[place])

    events: list[TimedCells] = []
    tables = {topic: Table(partial(rows_of, place)) for place, topic in enumerate(TOPICS)}
    tables["/events"] = Table(lambda: events)
    for row in every_tick():
        for topic, record in zip(TOPICS, row, strict=True):
            tables[topic].take(cells_of(record))
        outputs = row[1]
        events += (
            (event.t_s, {**cells_of(event), "mission_t_s": outputs.mission_time_s(event)}) for event in outputs.events
        )
    for _, cells in events:
        tables["/events"].take(cells)
    return tables
