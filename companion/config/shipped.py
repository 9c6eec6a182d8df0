"""The configuration files that every installation contains as package data; in the repository, they are in `configs/`."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from companion.config.document import ConfigError
from companion.config.explain import did_you_mean

FILES = Path(str(resources.files("companion.config"))) / "files"
"""Folder of the files, with a folder for each kind."""
DEFAULT_MISSION = "catch"
DEFAULT_VEHICLE = "tarot650_2r"


def names(folder: str) -> tuple[str, ...]:
    """Return the names of the shipped YAML files in a folder of `FILES`."""
    return tuple(sorted(path.stem for path in (FILES / folder).glob("*.yaml")))


def shipped_file(folder: str, name: str) -> Path:
    """Return the path of a shipped YAML file, shortened by `near`."""
    return near(FILES / folder / f"{name}.yaml")


def near(path: Path) -> Path:
    """Return an absolute path, made relative to the current directory if it lies within that directory."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path


def named_file(folder: str, given: str | Path, option: str = "") -> Path:
    """Return the path of the shipped file whose name is given; if there is none, return `given` as a path.

    Args:
        folder: folder of `FILES`.
        option: command-line option through which it was given, for messages.

    Raises:
        ConfigError: a word without a suffix is neither the name of a shipped file nor a file.
    """
    known = names(folder)
    if str(given) in known:
        return shipped_file(folder, str(given))
    if str(given) and not Path(given).suffix and not Path(given).exists():
        hint = did_you_mean(str(given), list(known))
        what = f"{option} {given}".lstrip()
        raise ConfigError(f"{what}: expected {', '.join(known)} or a file, found neither{hint}")
    return Path(given)
