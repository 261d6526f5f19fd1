"""A front end in a process of its own that is killed and started again at the same address."""

import signal
import subprocess
import sys
from pathlib import Path

from tests.support.service_harness import TOKEN, api_environment

ROOT = Path(__file__).parents[2]


class FrontEnd:
    """A front end on a database and a folder.

    Args:
        conninfo: of the database.
        folder: of its data.
        settings: further variables of its environment.
    """

    def __init__(self, conninfo: str, folder: Path, **settings: str) -> None:
        self._environment = {**api_environment(conninfo, folder), **settings}
        self.token = TOKEN
        self.address = ""
        self.start()

    def start(self) -> None:
        """Start it; returns when it takes requests."""
        self._process = subprocess.Popen(
            [sys.executable, "-m", "octasplat", "api"],
            env=self._environment, cwd=ROOT, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self._process.stdout is not None
        self.address = self._process.stdout.readline().split()[-1]
        assert self.address.startswith("http://"), self.address
        self._environment["OCTASPLAT_PORT"] = self.address.rpartition(":")[2]

    def kill(self) -> None:
        """End it as a crash does."""
        self._process.send_signal(signal.SIGKILL)
        self._process.wait(60)
        assert self._process.stdout is not None
        self._process.stdout.close()

    def __enter__(self) -> "FrontEnd":
        return self

    def __exit__(self, *_exception: object) -> None:
        self.kill()
