"""Writes self-contained HTML pages: one file with embedded pictures, suitable for printing."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from companion.analysis.table import Table

_INDEX = re.compile(r"\b([eMK])_(p|q|z|α|d|tau)\b")


@dataclass(frozen=True, slots=True)
class Picture:
    """A PNG file with its title and caption."""

    path: Path
    title: str
    caption: str


@dataclass(frozen=True, slots=True)
class Section:
    """A heading and the content below it; empty parts are omitted."""

    title: str
    lead: str = ""
    """Text above the tables."""
    tables: Sequence[Table] = ()
    pictures: Sequence[Picture] = ()
    text: str = ""
    """Text below the tables and pictures."""
    folded: Mapping[str, str] = field(default_factory=dict)
    """Long texts by title, shown when the reader opens them."""
    cards: Sequence[Table] = ()
    """Small tables, side by side at the top of the section."""


@dataclass(frozen=True, slots=True)
class Page:
    """The content of a page."""

    title: str
    subtitle: str
    sections: Sequence[Section]
    verdict: str = ""
    """One sentence at the top."""
    good: bool = True
    notes: Sequence[str] = ()
    """Notes to read before the values."""
    badge: str = ""
    """The outcome, beside the title."""
    player_html: str = ""
    """HTML element that plays an animation of the flight; inserted unchanged."""
    links: Sequence[tuple[str, str]] = ()
    """Text and relative address of the pages to which this one leads."""
    width_rem: int = 86
    """Maximum width of the text, rem."""


def write_page(page: Page, path: Path) -> None:
    """Write a page.

    Raises:
        OSError: the file cannot be written.
    """
    text = _environment().get_template("page.html").render(page=page)
    path.write_bytes(text.encode(errors="replace"))  # the name of a file may be no text


def _environment() -> Environment:
    found = Environment(
        loader=PackageLoader("companion.analysis", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.filters |= {"indices": _indices, "data": _data}
    return found


def _indices(text: str) -> Markup:
    """Escape the text and format the indices of symbols such as e_p as subscripts."""
    return Markup(_INDEX.sub(r"\1<sub>\2</sub>", str(escape(text))))


def _data(path: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()
