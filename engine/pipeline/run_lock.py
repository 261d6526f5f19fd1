"""Lock of a run's folder, for one process at a time."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from octasplat.engine.core.errors import OutputError
from octasplat.engine.core.partial_folders import FolderLockedError, lock_folder


@contextmanager
def lock_run_folder(output: Path) -> Iterator[None]:
    """Lock the folder of a run until the block or the process ends.

    A file system that has no locks goes without.

    Raises:
        OutputError: another process works there.
    """
    try:
        handle, _ = lock_folder(output)
    except FolderLockedError:
        raise OutputError(
            f"Another octasplat works on the run in {output}; wait for it or stop it, or name another folder."
        ) from None
    try:
        yield
    finally:
        os.close(handle)
