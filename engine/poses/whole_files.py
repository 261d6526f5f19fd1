"""Models and databases of a search, written whole or not at all."""

import errno
import os
import shutil
from pathlib import Path
from typing import Any

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.writing import report_disk_full
from octasplat.engine.dataset.colmap_binary import check_binary_colmap_model


def write_model(model: Any, folder: Path) -> None:
    """Write a ``pycolmap.Reconstruction`` into a folder, which is made if it is missing.

    Raises:
        DiskFullError: there is no room for it.
    """
    with report_disk_full(folder):
        folder.mkdir(parents=True, exist_ok=True)
        model.write_binary(folder)
        # COLMAP does not notice a full disk, and may never come to an end with files that are cut short.
        try:
            check_binary_colmap_model(folder)
        except DatasetError as error:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) from error


def copy_database(database: Path, copy: Path) -> Path:
    """Copy an SQLite database that nobody has open, and return the copy.

    Args:
        database: is only read.
        copy: is replaced, with all that a process which was killed may have left of it.
    """
    for suffix in ("", "-wal", "-shm"):  # SQLite would write changes that it finds there into the copy
        copy.with_name(copy.name + suffix).unlink(missing_ok=True)
    return Path(shutil.copyfile(database, copy))
