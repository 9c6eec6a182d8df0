"""Elements that all HTML pages share. A page is one self-contained file that prints well."""

from __future__ import annotations

import base64
from html import escape
from pathlib import Path

_STYLE = """
:root { --ink: #22303c; --soft: #5b6b79; --line: #dde3e8; --good: #1f8a5b; --bad: #c2255c; --card: #f6f8fa; }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2rem 1.5rem 4rem; max-width: var(--width); color: var(--ink); background: #fff;
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.6rem; margin: 0; } h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; }
.sub { color: var(--soft); margin: .2rem 0 1.2rem; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
td, th { border-bottom: 1px solid var(--line); vertical-align: top; }
th { color: var(--soft); font-weight: 600; font-size: .85rem; }
figure { margin: 0 0 1.6rem; break-inside: avoid; } figure img { width: 100%; border: 1px solid var(--line); border-radius: .4rem; }
figcaption { color: var(--soft); font-size: .88rem; }
details { margin-top: .6rem; } summary { cursor: pointer; color: var(--soft); }
pre { background: var(--card); padding: 1rem; border-radius: .5rem; overflow: auto; font-size: 12px; line-height: 1.4; }
@media print { body { padding: 0; max-width: none; font-size: 11px; } details { display: none; } }
"""


def opening(title: str, style: str) -> str:
    """Return everything before the body's content. `style` is CSS of this page and sets `--width` of `:root`."""
    return (
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width, initial-scale=1'>"
        f"<title>{escape(title)}</title><style>{_STYLE}{style}</style></head><body>"
    )


CLOSING = "</body></html>\n"


def picture(path: Path, title: str, caption_html: str) -> str:
    """Return a PNG embedded in the page."""
    data = base64.b64encode(path.read_bytes()).decode()
    return (
        f"<figure><img alt='{escape(title)}' src='data:image/png;base64,{data}'>"
        f"<figcaption>{caption_html}</figcaption></figure>"
    )


def folded(title: str, text: str) -> str:
    """Return text behind a disclosure widget, or nothing if it is empty."""
    return f"<details><summary>{escape(title)}</summary><pre>{escape(text)}</pre></details>" if text else ""
