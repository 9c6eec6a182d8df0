"""What the site needs beside the pages (MkDocs hooks): files of the repository that pages link to, headings' names as on GitHub, and
how many commits figures are behind the code.

Pages are written to be read in the repository. In the site, a link that leaves docs/ leads to a copy below `repository/`.
"""

from __future__ import annotations

import posixpath
import re
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

OUTSIDE = "repository"
FLIGHT_CODE = (
    "companion/control",
    "companion/core",
    "companion/safety",
    "companion/sitl_config",
    "configs/controllers",
    "configs/worlds",
    "sitl",
)
"""What the figures of a flight depend on."""
COMMIT = re.compile(r"(?:\bcommit\s+|\b(?=\d*[a-f]))([0-9a-f]{7,40})\b")
"""A word that may be a commit's name: pages also say `at 1c535d28`, `commit` before a line break, or lists of them."""
_LINK = re.compile(r"(?<=\]\()(?!\w+:|#)([^)#\s]+)")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Name headings as GitHub does: links with a heading in them must hold in both places."""
    config.mdx_configs.setdefault("toc", {})["slugify"] = github_name
    return config


def github_name(heading: str, separator: str = "-") -> str:
    """`Gate & ladder` becomes `gate--ladder`."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", separator)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what pages link to outside of docs/, and what those link to in turn."""
    root, docs = Path(config.config_file_path).parent, Path(config.docs_dir)
    waiting = [(f"docs/{file.src_uri}", docs / file.src_uri) for file in files.documentation_pages()]
    while waiting:
        place, path = waiting.pop()
        for target in _LINK.findall(path.read_text(encoding="utf-8")):
            linked = posixpath.normpath(posixpath.join(posixpath.dirname(place), target))
            uri = _uri(linked)
            if not uri.startswith(f"{OUTSIDE}/") or files.get_file_from_path(uri) or not (root / linked).is_file():
                continue
            files.append(File.generated(config, uri, abs_src_path=str(root / linked)))
            if linked.endswith(".md"):
                waiting.append((linked, root / linked))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Lead links that leave docs/ to the copies; indent what stands in a numbered list as MkDocs wants it; age the figures."""
    uri = page.file.src_uri
    place = uri.removeprefix(f"{OUTSIDE}/") if uri.startswith(f"{OUTSIDE}/") else f"docs/{uri}"

    def led(link: re.Match[str]) -> str:
        linked = posixpath.normpath(posixpath.join(posixpath.dirname(place), link[1]))
        return posixpath.relpath(_uri(linked), posixpath.dirname(uri) or ".")

    root = Path(config.config_file_path).parent

    def changed(text: str) -> str:
        text = COMMIT.sub(lambda found: found[0] + _age(found[1], root), text)
        return re.sub(r"^ {3}(?=\S)", " " * 4, _LINK.sub(led, text), flags=re.M)

    return _outside_of_fences(markdown, changed)


@cache
def _age(commit: str, root: Path) -> str:
    """` (12 later commits change the code of flights)`; empty if there is none, or without git or the commit."""
    command = ["git", "rev-list", "--count", f"{commit}..HEAD", "--", *FLIGHT_CODE]
    try:
        later = int(subprocess.run(command, cwd=root, capture_output=True, text=True, check=True).stdout)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return f" ({later} later commits change the code of flights)" if later else ""


def _uri(path: str) -> str:
    """Where a file of the repository is in the site."""
    return path.removeprefix("docs/") if path.startswith("docs/") else f"{OUTSIDE}/{path}"


def _outside_of_fences(markdown: str, change: Callable[[str], str]) -> str:
    parts = re.split(r"(^```.*?^```$)", markdown, flags=re.M | re.S)
    return "".join(part if part.startswith("```") else change(part) for part in parts)
