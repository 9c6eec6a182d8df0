"""The compiled build: a copy of `companion` and `sitl` in build/compiled, in which mypyc has compiled the computational modules.

`python -m tools.compiled` makes it. The compiled build gives bit-identical results to the source. It runs in place of the source when
it is first on the module path: `PYTHONSAFEPATH=1 PYTHONPATH=$PWD/build/compiled .venv/bin/companion ...`. The source tree is not
changed.
"""

from __future__ import annotations

import filecmp
import os
import shutil
import sys
import sysconfig
from pathlib import Path

from companion.recorder.versions import REVISION_FILE, versions

ROOT = Path(__file__).parent.parent
BUILD = ROOT / "build" / "compiled"
WORK = ROOT / "build" / "mypyc"
"""Folder for the generated C code, the object files and mypy's cache."""
PACKAGES = ("companion", "sitl")
COMPILED = (
    "companion/core/*.py",
    "companion/control/**/*.py",
    "companion/safety/*.py",
    "companion/mission/*.py",
    "companion/model/*.py",
    "companion/io/dynamixel/registers.py",
    "companion/io/px4/delta_velocity.py",
    "sitl/autopilot/*.py",
    "sitl/faults/injector.py",
    "sitl/fast/*.py",
    "sitl/force_torque.py",
    "sitl/servo/*.py",
    "sitl/world/**/*.py",
)
INTERPRETED = frozenset(
    {
        # Records: mypyc ignores the options of a class, here kw_only=True, tag=True and those of the base class.
        "companion/control/types.py",
        "companion/model/check_row.py",
        "companion/model/codec.py",
        "companion/model/observations.py",
        "companion/model/packets.py",
        "companion/model/types.py",
        # I/O, which the fast loop does not have; mypyc does not support asynchronous generators.
        "sitl/autopilot/backend.py",
        "sitl/autopilot/mavlink.py",
        "sitl/autopilot/receive.py",
        "sitl/autopilot/streams.py",
        "sitl/servo/bus.py",
        "sitl/servo/protocol.py",
    }
)
"""Files that match `COMPILED` but stay plain Python."""
FLAGS = "-O2 -ffp-contract=off"
"""Compiler flags without fused multiply-add, which would change the last bits on processors that have it (aarch64)."""


def sources() -> list[Path]:
    """Return the paths of all files of the packages, relative to the root of the repository."""
    found = (path for package in PACKAGES for path in (ROOT / package).rglob("*"))
    return [path.relative_to(ROOT) for path in found if path.is_file() and path.parent.name != "__pycache__"]


def modules() -> list[str]:
    """Return the paths of the files to compile, relative to the root of the repository."""
    found = {str(path.relative_to(ROOT)) for pattern in COMPILED for path in ROOT.glob(pattern)}
    return sorted(name for name in found - INTERPRETED if not name.endswith("__init__.py"))


def is_current() -> bool:
    """Return whether the compiled build exists and was made from the present source."""
    return next(BUILD.glob("*.so"), None) is not None and all(
        (BUILD / path).exists() and filecmp.cmp(ROOT / path, BUILD / path, shallow=False) for path in sources()
    )


def build() -> None:
    """Copy the packages and compile the modules of the copy."""
    from mypyc.build import mypycify
    from setuptools import setup

    shutil.rmtree(BUILD, ignore_errors=True)
    for package in PACKAGES:
        shutil.copytree(ROOT / package, BUILD / package, ignore=shutil.ignore_patterns("__pycache__"))
    (BUILD / REVISION_FILE).write_text(versions().get("git", ""), encoding="utf-8")
    WORK.mkdir(exist_ok=True)
    os.environ["CFLAGS"] = FLAGS
    os.chdir(BUILD)
    extensions = mypycify(
        [f"--config-file={ROOT / 'pyproject.toml'}", f"--cache-dir={WORK / 'cache'}", *modules()],
        debug_level="0",
        group_name="companion_sitl",
        multi_file=True,
        target_dir=str(WORK / "c"),
    )
    folders = [f"--build-lib={WORK / 'lib'}", f"--build-temp={WORK / 'objects'}"]
    setup(name="compiled", packages=[], ext_modules=extensions, script_args=["-q", "build_ext", "--inplace", *folders])
    shutil.copy(
        ROOT / "pyproject.toml", BUILD
    )  # it announces the control laws; not earlier, because setup() would read it


def main() -> int:
    """Make the compiled build, print how to use it, and return the exit code."""
    compiler = str(sysconfig.get_config_var("CC")).split()[0]
    if shutil.which(compiler) is None:
        print(f"no C compiler ({compiler}): on Debian, apt install gcc python3-dev", file=sys.stderr)
        return 1
    build()
    print(f"compiled: PYTHONSAFEPATH=1 PYTHONPATH={BUILD} .venv/bin/companion ...")
    return 0


if __name__ == "__main__":
    sys.exit(main())
