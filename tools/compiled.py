"""The compiled build: a wheel of `companion` and `sitl` in which mypyc has compiled the computational modules.

`python -m tools.compiled` builds the wheel in build/compiled and installs it in place of the program that is installed in this Python
environment. The compiled build gives bit-identical results to the source, which is not changed.

gcc compiles twice: the first build counts in the `TRAINING` flights which branches are taken, the second one is laid out accordingly,
and a step of the flight core takes an eighth less. Other compilers, and a computer without the packages of SITL, compile once.
"""

from __future__ import annotations

import ast
import contextlib
import filecmp
import io
import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
import warnings
from importlib.util import find_spec
from pathlib import Path

from companion.recorder.versions import REVISION_FILE, versions

ROOT = Path(__file__).parent.parent
WHEELS = ROOT / "build" / "compiled"
"""Folder of the wheel."""
BUILD = WHEELS / "files"
"""The content of the wheel: first on the module path, it runs without being installed."""
WORK = ROOT / "build" / "mypyc"
"""Folder for the generated C code, the object files and mypy's cache."""
PACKAGES = ("companion", "sitl")
SETTINGS = "companion/config/files"
"""A link to configs/, which the wheel contains as files."""
# Without companion/io/dynamixel/port.py: it extends a class of the servos' SDK, which crashes a compiled process.
COMPILED = (
    "companion/core/*.py",
    "companion/control/**/*.py",
    "companion/safety/*.py",
    "companion/mission/*.py",
    "companion/phases/contact/force.py",
    "companion/phases/contact/machine.py",
    "companion/phases/contact/points.py",
    "companion/phases/contact/sliding.py",
    "companion/phases/contact/surface.py",
    "companion/phases/contact/way.py",
    "companion/phases/intercept/ball.py",
    "companion/phases/intercept/lag.py",
    "companion/phases/intercept/meeting.py",
    "companion/phases/intercept/motion.py",
    "companion/phases/intercept/net.py",
    "companion/phases/intercept/rotors.py",
    "companion/model/*.py",
    "companion/io/dynamixel/scale.py",
    "companion/io/px4/delta_velocity.py",
    "sitl/autopilot/*.py",
    "sitl/faults/injector.py",
    "sitl/fast/*.py",
    "sitl/force_torque.py",
    "sitl/mocap.py",
    "sitl/plant.py",
    "sitl/servo/*.py",
    "sitl/world/**/*.py",
)
INTERPRETED = frozenset(
    {
        # Its time is that of onnxruntime.
        "companion/control/policy.py",
        # A Pydantic model.
        "companion/mission/phase.py",
        # I/O, which the fast loop does not have; mypyc does not support asynchronous generators.
        "sitl/autopilot/backend.py",
        "sitl/autopilot/mavlink.py",
        "sitl/autopilot/receive.py",
        "sitl/autopilot/streams.py",
        "sitl/servo/bus.py",
        "sitl/servo/protocol.py",
    }
)
"""Files that match `COMPILED` but stay plain Python, as do those with `_options_of_classes`."""
FLAGS = f"-ffp-contract=off -fvisibility=hidden -include {shlex.quote(str(ROOT / 'tools' / 'record_fields.h'))}"
"""Compiler flags: without fused multiply-add, which would change the last bits on processors that have it (aarch64), with direct calls
between the modules, which lie in one library, and with fast reads of records' fields.
"""

COUNTING = ["-fprofile-generate", "-fprofile-update=single"]
COUNTED = ["-fprofile-use", "-fprofile-partial-training", "-Wno-missing-profile"]
"""Flags of gcc for the two builds; what no training flight reaches is compiled as usual."""
TRAINING = """
from companion.sitl_config.loader import load_sitl
from sitl.fast.loop import FastFlight

for mission, world in ("catch", "lab"), ("press", "wall"):
    FastFlight(load_sitl(f"configs/missions/{mission}.yaml", world=world)).run(120.0)
"""


def sources() -> list[Path]:
    """Return the paths of all files of the packages, relative to the root of the repository."""
    found = (path for folder in (*PACKAGES, SETTINGS) for path in (ROOT / folder).rglob("*"))
    return [path.relative_to(ROOT) for path in found if path.is_file() and path.parent.name != "__pycache__"]


def modules() -> list[str]:
    """Return the paths of the files to compile, relative to the root of the repository."""
    found = {str(path.relative_to(ROOT)) for pattern in COMPILED for path in ROOT.glob(pattern)}
    return sorted(
        name
        for name in found - INTERPRETED
        if not name.endswith("__init__.py") and _options_of_classes(ROOT / name) <= {"frozen"}
    )


def _options_of_classes(path: Path) -> set[str | None]:
    """Return the options of the classes in a file, such as kw_only and tag. mypyc ignores them and keeps no types of fields, so that
    records which another process or a log is to decode, which have them, stay plain Python.
    """
    classes = (node for node in ast.walk(ast.parse(path.read_bytes())) if isinstance(node, ast.ClassDef))
    return {option.arg for one in classes for option in one.keywords}


def is_current() -> bool:
    """Return whether the compiled build exists and was made from the present source."""
    return next(WHEELS.glob("*.whl"), None) is not None and all(
        (BUILD / path).exists() and filecmp.cmp(ROOT / path, BUILD / path, shallow=False) for path in sources()
    )


def build() -> Path:
    """Compile the modules and return the path of the wheel."""
    from mypyc.build import mypycify
    from pybind11.setup_helpers import ParallelCompile
    from setuptools import setup
    from setuptools.command.build_py import build_py

    class WithRevision(build_py):  # type: ignore[misc]
        """Copies the packages, with the commit from which they are built."""

        def run(self) -> None:
            super().run()
            (BUILD / "companion" / REVISION_FILE).write_text(revision, encoding="utf-8")

    revision = versions().get("git", "")
    shutil.rmtree(WHEELS, ignore_errors=True)
    WORK.mkdir(parents=True, exist_ok=True)
    os.environ["CFLAGS"] = FLAGS
    os.chdir(ROOT)
    print("compiling for some minutes ...", flush=True)
    said = io.StringIO()  # warnings about generator expressions, hundreds of lines; the errors if there are any
    try:
        with contextlib.redirect_stdout(said):
            extensions = mypycify(
                [f"--config-file={ROOT / 'pyproject.toml'}", f"--cache-dir={WORK / 'cache'}", *modules()],
                opt_level="2",
                debug_level="0",
                group_name="companion_sitl",
                multi_file=True,
                target_dir=str(WORK / "c"),
            )
    except SystemExit:
        print(said.getvalue(), file=sys.stderr)
        raise
    warnings.filterwarnings("ignore", module="setuptools|distutils")  # they recommend other ways to call them
    ParallelCompile(default=len(os.sched_getaffinity(0))).install()

    plain = [list(extension.extra_compile_args) for extension in extensions]

    def make(flags: list[str], *command: str) -> None:
        for extension, own in zip(extensions, plain, strict=True):
            extension.extra_compile_args, extension.extra_link_args = [*own, *flags], flags
        setup(
            ext_modules=extensions,
            cmdclass={"build_py": WithRevision},
            options={
                "build": {"build_base": str(WORK), "build_lib": str(BUILD)},
                "build_ext": {"force": True},
                "egg_info": {"egg_base": str(WORK)},
            },
            script_args=["-q", *command],
        )

    flags: list[str] = []
    if "gcc" in compiler() and find_spec("mujoco") is not None:
        for counts in WORK.rglob("*.gcda"):
            counts.unlink()
        make(COUNTING, "build")
        subprocess.run([sys.executable, "-P", "-c", TRAINING], env={**os.environ, "PYTHONPATH": str(BUILD)}, check=True)
        flags = COUNTED
    make(flags, "bdist_wheel", f"--dist-dir={WHEELS}")
    return next(WHEELS.glob("*.whl"))


def compiler() -> str:
    """Return the name of the C compiler with which extensions of this Python are built."""
    return str(sysconfig.get_config_var("CC")).split()[0]


def main() -> int:
    """Build and install the wheel unless a current one exists, print how to undo it, and return the exit code."""
    if shutil.which(compiler()) is None:
        print(f"no C compiler ({compiler()}): on Debian, apt install gcc python3-dev", file=sys.stderr)
        return 1
    wheel = next(WHEELS.glob("*.whl")) if is_current() else build()
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    subprocess.run([*pip, "install", "--quiet", "--no-deps", "--no-index", "--force-reinstall", str(wheel)], check=True)
    print(f"installed: {wheel}")
    print("back to plain Python: .venv/bin/pip install --no-deps --no-build-isolation --editable .")
    return 0


if __name__ == "__main__":
    sys.exit(main())
