"""A real `px4` (SITL) as a child process. This module finds the program, claims a free instance number, starts PX4 in a folder of its
own and stops it.

PX4 writes its parameters, its logs (`log/*.ulg`) and its output (`px4.log`) to that folder. Outside the folder, it writes only
`/tmp/px4_lock-N` and `/tmp/px4-sock-N`.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import errno
import os
import shutil
import signal
import socket
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from companion.runtime.subprocesses import how_it_ended
from sitl.px4.hil_link import Px4Error

VARIABLE = "PX4_SITL"
"""Environment variable that names the px4 binary or its build folder (build/px4_sitl_default)."""
MODEL = "none_iris"
"""Value of PX4_SIM_MODEL: a quad-x with an external simulator, configured by parameters."""
INSTANCES = range(10)
"""Usable instance numbers; PX4 instances with a number of 10 or above all send to the same port, UDP 14549."""
HOST = "127.0.0.1"
HOW_TO_GET_IT = (
    "set PX4_SITL to the build folder of PX4 (make px4_sitl_default none in PX4-Autopilot), or install the px4 package"
)
_SIMULATOR, _ONBOARD, _ONBOARD_OWN, _GROUND_OWN = 4560, 14540, 14580, 18570
_CAMERA, _CAMERA_OWN, _GIMBAL_OWN = 14030, 14280, 13030
_LOG = "px4.log"
_TAIL_BYTES = 20000
_libc = ctypes.CDLL(None)
_PR_SET_PDEATHSIG = 1


def how_to_start_it(number: int) -> str:
    """Return the commands that start a PX4 of this instance by hand; `make` starts instance 0 only."""
    by_make = f" or `PX4_SIM_MODEL={MODEL} make px4_sitl_default none`" if number == 0 else ""
    return f"`PX4_SIM_MODEL={MODEL} px4 -i {number}` (always in the same folder, because PX4 stores its parameters there){by_make}"


@dataclass(frozen=True, slots=True)
class Installation:
    """A PX4 that can be started."""

    binary: Path
    etc: Path
    """Folder of PX4's start scripts (ROMFS)."""


def find(environment: Mapping[str, str] | None = None) -> Installation | None:
    """Return the PX4 that PX4_SITL names; without PX4_SITL, the PX4 on PATH; None if neither is found.

    Raises:
        Px4Error: PX4_SITL does not name a program, or the program has no start scripts.
    """
    environment = os.environ if environment is None else environment
    named = environment.get(VARIABLE, "")
    if named:
        given = Path(named).expanduser()
        binary = given / "bin" / "px4" if given.is_dir() else given
        if not (binary.is_file() and os.access(binary, os.X_OK)):
            raise Px4Error(
                f"{VARIABLE}={named}: expected the px4 binary or the folder of its build, found no program at {binary}; "
                f"{HOW_TO_GET_IT}"
            )
        return _with_etc(binary, f"{VARIABLE}={named}")
    on_path = shutil.which("px4", path=environment.get("PATH"))
    return None if on_path is None else _with_etc(Path(on_path), f"px4 on PATH ({on_path})")


def _with_etc(binary: Path, origin: str) -> Installation:
    real = binary.resolve()
    for root in dict.fromkeys((binary.parent.parent, real.parent.parent, real.parent)):
        for etc in (root / "etc", root / "share" / "px4" / "etc", root / "ROMFS" / "px4fmu_common"):
            if (etc / "init.d-posix" / "rcS").is_file():
                return Installation(real, etc.resolve())
    raise Px4Error(
        f"{origin}: expected PX4's start scripts (etc/init.d-posix/rcS) next to the binary, found none; {HOW_TO_GET_IT}"
    )


class Instance:
    """A reserved instance number with the sockets that reserve it; a context manager, or closed with `close`.

    The process that listens on the simulator's TCP port owns the number.
    """

    def __init__(self, number: int, simulator: socket.socket, control: socket.socket) -> None:
        self.number = number
        self.simulator = simulator
        """Listening TCP socket to which PX4 connects."""
        self.control = control
        """UDP socket that receives PX4's camera link."""

    @property
    def onboard_port(self) -> int:
        """UDP port to which PX4 sends its onboard link: 14540 for instance 0."""
        return _ONBOARD + self.number

    @property
    def onboard_address(self) -> tuple[str, int]:
        """Address on which PX4's onboard link listens."""
        return (HOST, _ONBOARD_OWN + self.number)

    @property
    def control_address(self) -> tuple[str, int]:
        """Address on which PX4's camera link listens."""
        return (HOST, _CAMERA_OWN + self.number)

    @property
    def gimbal_address(self) -> tuple[str, int]:
        """Address on which PX4's gimbal link listens."""
        return (HOST, _GIMBAL_OWN + self.number)

    @classmethod
    def claim(cls, numbers: range = INSTANCES) -> Instance:
        """Reserve and return the first free instance.

        Raises:
            Px4Error: every instance is in use.
        """
        for number in numbers:
            instance = cls._try(number)
            if instance is not None:
                return instance
        raise Px4Error(
            f"PX4: expected one of the instances {numbers.start} to {numbers.stop - 1} to be free, found their ports in use "
            f"(TCP {_SIMULATOR}+N, UDP {_ONBOARD}+N, {_ONBOARD_OWN}+N, ...); end other simulators"
        )

    @classmethod
    def _try(cls, number: int) -> Instance | None:
        with contextlib.ExitStack() as stack:
            simulator = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_STREAM))
            simulator.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # only past connections keep a port busy
            control = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            try:
                simulator.bind((HOST, _SIMULATOR + number))
                simulator.listen(1)
                control.bind((HOST, _CAMERA + number))
                for port in (_ONBOARD, _ONBOARD_OWN, _GROUND_OWN, _CAMERA_OWN, _GIMBAL_OWN):
                    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                        probe.bind((HOST, port + number))
            except OSError as error:
                if error.errno == errno.EADDRINUSE:
                    return None
                raise
            stack.pop_all()
        simulator.setblocking(False)
        control.setblocking(False)
        return cls(number, simulator, control)

    def close(self) -> None:
        """Release the number."""
        self.simulator.close()
        self.control.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def abandoned_instance() -> int | None:
    """Return the first instance whose PX4 runs without a simulator, or None. A new PX4 opens its links only when it has found one."""
    for number in INSTANCES:
        with (
            socket.socket(socket.AF_INET, socket.SOCK_STREAM) as simulator,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link,
        ):
            simulator.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                simulator.bind((HOST, _SIMULATOR + number))
            except OSError:
                continue  # it flies, in another world
            try:
                link.bind((HOST, _ONBOARD_OWN + number))
            except OSError:
                return number
    return None


class Px4Process:
    """A running PX4.

    Args:
        folder: PX4's working folder, created if it does not exist; PX4 keeps its parameters there between starts.
        settings: parameters to set before PX4's modules start (PX4_PARAM_* in its start script).

    Raises:
        Px4Error: PX4 cannot be started.
    """

    def __init__(
        self, installation: Installation, instance: Instance, folder: Path, settings: Mapping[str, int | float]
    ) -> None:
        self.log = folder / _LOG
        self._number = instance.number
        command = [str(installation.binary), "-i", str(instance.number), "-d", str(installation.etc)]
        environment = {name: value for name, value in os.environ.items() if not name.startswith(("PX4_", "MAVLINK"))}
        environment["PX4_SIM_MODEL"] = MODEL
        environment |= {f"PX4_PARAM_{name}": str(value) for name, value in settings.items()}
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with open(self.log, "ab") as log:
                self._process = subprocess.Popen(
                    [*command, "-s", "etc/init.d-posix/rcS"],
                    cwd=folder,
                    env=environment,
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,
                    preexec_fn=_before_exec,
                )
        except OSError as error:
            raise Px4Error(f"PX4: cannot start {installation.binary} in {folder}: {error.strerror}") from None

    @property
    def pid(self) -> int:
        """Process id of PX4."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether PX4 is still running."""
        return self._process.poll() is None

    def exit_summary(self) -> str:
        """Return one line that describes how PX4 ended."""
        code = self._process.poll()
        how = "is running" if code is None else how_it_ended(code)
        return f"PX4: px4 -i {self._number} {how}{self._last_error_line()}; see {self.log}"

    async def await_end(self, deadline_s: float) -> bool:
        """Wait until PX4 has ended; return False at the timeout."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            await asyncio.to_thread(self._process.wait, deadline_s)
        return not self.running

    def terminate(self) -> None:
        """Send SIGTERM to PX4. In lockstep, PX4 needs samples until it has ended, because they drive its clock."""
        if self.running:
            self._process.terminate()

    def kill(self) -> None:
        """Kill PX4 and remove the files that it left in /tmp."""
        if self.running:
            self._process.kill()
        self._process.wait()
        for name in (f"/tmp/px4_lock-{self._number}", f"/tmp/px4-sock-{self._number}"):
            with contextlib.suppress(OSError):
                os.unlink(name)

    def _last_error_line(self) -> str:
        said = _tail(self.log)
        complaints = [line.strip() for line in said if "ERROR" in line or "PANIC" in line or "No such" in line]
        # If a signal ended PX4, its last error line is not the cause.
        return f" ({complaints[-1][:160]})" if complaints and self._process.returncode > 0 else ""


def _before_exec() -> None:
    """Prepare the child process: it ends with its parent, as PX4 waits forever for a simulator, without real-time priority."""
    _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def _tail(path: Path) -> list[str]:
    with contextlib.suppress(OSError), open(path, "rb") as log:
        log.seek(max(0, log.seek(0, os.SEEK_END) - _TAIL_BYTES))
        return log.read().decode(errors="replace").splitlines()
    return []
