"""Flat arrays in files that are mapped into memory, not read."""

import mmap
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64


@dataclass(frozen=True, eq=False)
class MappedArray:
    """A read-only flat array over a mapped file; its pages can be released at any time."""

    values: np.ndarray[Any, np.dtype[Any]]
    _map: mmap.mmap | None = None

    @classmethod
    def open(cls, path: Path, dtype: Any) -> "MappedArray":
        """Map the file at ``path`` as a flat array of ``dtype``.

        A file below half of the machine's memory is read ahead; of a larger one only the requested pages are
        read, as read-ahead would load many unused neighbours.
        """
        size = path.stat().st_size
        if size == 0:  # an empty file cannot be mapped
            return cls.empty(dtype)
        with path.open("rb") as handle:
            mapped = mmap.mmap(handle.fileno(), 0, access=mmap.ACCESS_READ)
        mapped.madvise(mmap.MADV_WILLNEED if size < _read_ahead_bytes() else mmap.MADV_RANDOM)
        return cls(np.frombuffer(mapped, dtype=dtype), mapped)

    @classmethod
    def empty(cls, dtype: Any) -> "MappedArray":
        """Return an array without values that stands for a missing file."""
        values = np.zeros(0, dtype=dtype)
        values.flags.writeable = False  # the same compiled kernels as for mapped files
        return cls(values)

    def read_ahead(self, ranges: Int64[np.ndarray, "n 2"]) -> None:
        """Read ranges of values, by their first and end, if all of them take less than half of the memory.

        Where they are needed in a random order, single pages take a hundred times as long.
        """
        if self._map is None:
            return
        first = ranges[:, 0] * self.values.itemsize // mmap.PAGESIZE * mmap.PAGESIZE
        length = ranges[:, 1] * self.values.itemsize - first
        if length.sum() < _read_ahead_bytes():
            for start, count in zip(first.tolist(), length.tolist(), strict=True):
                if count > 0:
                    self._map.madvise(mmap.MADV_WILLNEED, start, count)

    def release(self) -> None:
        """Release the pages to the system; they are read again when they are next used."""
        if self._map is not None:
            self._map.madvise(mmap.MADV_DONTNEED)


def _read_ahead_bytes() -> float:
    """Return half of the machine's memory."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2
