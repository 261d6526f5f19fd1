"""Lock of a run's folder, for one process at a time."""

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from octasplat.engine.core.errors import OutputError

_LOCKED_ERRORS = frozenset({errno.EAGAIN, errno.EACCES})


@contextmanager
def lock_run_folder(output: Path) -> Iterator[None]:
    """Lock the folder of a run until the block or the process ends.

    A file system that has no locks goes without.

    Raises:
        OutputError: another process works there.
    """
    folder = os.open(output, os.O_RDONLY | os.O_DIRECTORY)  # the folder itself: no lock file is left behind
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in _LOCKED_ERRORS:  # any other error: a file system without locks
                raise OutputError(
                    f"Another octasplat works on the run in {output}; wait for it or stop it, or name "
                    "another folder."
                ) from None
        yield
    finally:
        os.close(folder)
