"""Arrays in files without a name, for what is larger than the memory should be that a step takes."""

import math
import os
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from octasplat.engine.core.errors import DiskFullError
from octasplat.engine.core.writing import report_disk_full


def new_array(shape: tuple[int, ...], dtype: DTypeLike, folder: Path | None) -> np.ndarray:
    """Return an array with any values in it: in memory, or in a file in a folder.

    The file has no name, so that nothing is left of it when the array is gone, whatever happens. It spares
    memory and is no more than that: where none can be made, or the file system maps none, the array is in
    memory.

    Args:
        shape: of the array.
        dtype: of its numbers.
        folder: for the file; None for an array in memory.

    Raises:
        DiskFullError: there is no room for the file.

    >>> new_array((2, 3), np.int32, None).shape
    (2, 3)
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if folder is None or size == 0:
        return np.empty(shape, dtype)
    try:
        with report_disk_full(folder), tempfile.TemporaryFile(dir=folder) as handle:
            # Not a file with holes: a full disk would end the program when they are filled.
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(handle.fileno(), 0, size)
            else:  # macOS
                handle.truncate(size)
            return np.asarray(np.memmap(handle, dtype, "r+", shape=shape))
    except DiskFullError:
        raise
    except OSError:
        return np.empty(shape, dtype)
