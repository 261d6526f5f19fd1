"""A process that is killed before one of its renames, as far as files tell."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest


class KilledError(BaseException):
    """Stands for the end of the process."""


@contextmanager
def killed_before_rename(number: int) -> Iterator[None]:
    """Leave the block before the rename of this number, from 0, if it comes to so many."""
    count, rename = 0, Path.rename

    def rename_or_die(path: Path, target: Path) -> Path:
        nonlocal count
        count += 1
        if count > number:
            raise KilledError
        return rename(path, target)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Path, "rename", rename_or_die)
        with suppress(KilledError):
            yield
