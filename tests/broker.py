"""A real mosquitto on a free port of loopback, started and ended by a test."""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.browser import missing
from tests.support import DEADLINE_S, ROOT, free_port

LOOPBACK = ROOT / "configs/mosquitto/loopback.conf"


def mosquitto() -> str:
    """Path of the broker; `make test` installs it where it can."""
    found = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin")
    if found is None:
        missing("a broker", "mosquitto")
        raise AssertionError
    return found


class Broker:
    """A mosquitto that runs with a configuration file; it can be killed, stopped, and started again on the same port."""

    def __init__(self, folder: Path, config: Path, port: int) -> None:
        self.port = port
        self.url = f"mqtt://127.0.0.1:{port}"
        self._log_path = folder / "mosquitto.log"
        self._config = config
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def log(self) -> str:
        """Everything that it has logged."""
        return self._log_path.read_text(encoding="utf-8", errors="replace")

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def start(self) -> None:
        """Start it and wait until it takes connections."""
        with open(self._log_path, "ab") as log:
            self._process = subprocess.Popen(
                [mosquitto(), "-c", str(self._config)], stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )
        deadline_s = time.monotonic() + DEADLINE_S
        while True:
            assert self._process.poll() is None, self.log
            try:
                socket.create_connection(("127.0.0.1", self.port), 1.0).close()
                return
            except OSError:
                assert time.monotonic() < deadline_s, self.log
                time.sleep(0.02)

    def kill(self) -> None:
        """As if its computer had lost its power, but for the sockets."""
        self.signal(signal.SIGKILL)
        self.wait()

    def signal(self, number: signal.Signals) -> None:
        assert self._process is not None
        self._process.send_signal(number)

    def wait(self) -> None:
        assert self._process is not None
        self._process.wait(DEADLINE_S)

    def stop(self) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGCONT)
            self._process.terminate()
            self._process.wait(DEADLINE_S)


@contextmanager
def loopback_broker(folder: Path) -> Iterator[Broker]:
    """The supplied loopback profile, on a free port."""
    port = free_port()
    config = folder / "loopback.conf"
    text = LOOPBACK.read_text(encoding="utf-8")
    assert "listener 1883 127.0.0.1\n" in text
    config.write_text(text.replace("listener 1883 127.0.0.1\n", f"listener {port} 127.0.0.1\n"), encoding="utf-8")
    broker = Broker(folder, config, port)
    broker.start()
    try:
        yield broker
    finally:
        broker.stop()
