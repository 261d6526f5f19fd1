"""Atomic writing of files and exchange of folders, with errors of a full disk that name the file."""

import errno
import json
import os
import re
import shutil
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from octasplat.engine.core.errors import DiskFullError

DISK_FULL_ERRORS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""Errors of the system that mean a full disk, a spent quota, or a limit on the size of files."""
_MIN_FREE_BYTES = 16 << 20
"""Room for what a library writes at a time, as into a database."""
_PARTIAL_NAME = re.compile(r"\.(.+)\.(\d+)\.partial(\.[^.]+)?")
"""Stem, process and suffix of what :func:`atomic_replace` writes."""
_SILENT_SECONDS = 60.0


@contextmanager
def report_disk_full(path: Path) -> Iterator[None]:
    """Raise errors of a full disk inside the block as an error that names ``path``.

    Raises:
        DiskFullError: there is no room for it.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in DISK_FULL_ERRORS:
            raise
        raise DiskFullError(f"{path} cannot be written ({error.strerror}); free space there.") from error


def full_disk_error(folder: Path) -> DiskFullError | None:
    """Return the likely cause where a library fails that tells of no full disk; None if there is room."""
    if shutil.disk_usage(folder).free >= _MIN_FREE_BYTES:
        return None
    return DiskFullError(f"{folder} cannot be written ({os.strerror(errno.ENOSPC)}); free space there.")


@contextmanager
def atomic_replace(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that takes its place when the block ends without an error.

    The temporary name keeps the suffix of ``path``, so that writers which look at it work as usual. On an
    error the temporary file is removed and ``path`` is left as it was.

    Raises:
        DiskFullError: there is no room for it.
    """
    with report_disk_full(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        # The process id keeps two processes apart that write the same file.
        temporary = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
        try:
            yield temporary
            # Content before name: after a power failure the file is the old or the new one, never empty.
            # Open for writing, as Windows flushes no others.
            with temporary.open("r+b") as handle:
                os.fsync(handle.fileno())
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def remove_abandoned(paths: Iterable[Path]) -> None:
    """Remove the partial files of :func:`atomic_replace` that killed processes have left beside these files.

    What may still be written stays: by a process that runs here or, as on a shared disk, by one that runs
    elsewhere, whose file changed within the last minute.
    """
    names: dict[Path, set[str]] = {}
    for path in paths:
        names.setdefault(path.parent, set()).add(path.name)
    for folder, wanted in names.items():
        with suppress(OSError):
            for left in list(folder.iterdir()):
                match = _PARTIAL_NAME.fullmatch(left.name)
                if match is None or match[1] + (match[3] or "") not in wanted or _is_running(int(match[2])):
                    continue
                with suppress(OSError):
                    if time.time() - left.lstat().st_mtime > _SILENT_SECONDS:
                        left.unlink()


def _is_running(process: int) -> bool:
    """Return whether there is a process of this number on this machine."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True  # of somebody else, or no number of a process
    return True


def write_text(path: Path, text: str) -> None:
    """Write ``text`` as UTF-8 to ``path``, atomically."""
    with atomic_replace(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: object) -> None:
    """Write ``value`` as indented JSON to ``path``, atomically."""
    write_text(path, json.dumps(value, indent=2) + "\n")


def replace_folder(folder: Path, new: Path) -> None:
    """Put ``new`` in the place of ``folder``, if that is there, and remove the former one.

    For a process that is killed meanwhile see :func:`restore_folder`.
    """
    former = former_folder(folder)
    shutil.rmtree(former, ignore_errors=True)
    if folder.is_dir():  # no system function exchanges two folders everywhere
        folder.rename(former)
    new.rename(folder)
    shutil.rmtree(former, ignore_errors=True)


def restore_folder(folder: Path) -> None:
    """Put the former folder back where :func:`replace_folder` was killed before the new one was there."""
    former = former_folder(folder)
    if former.is_dir() and not folder.exists():
        former.rename(folder)
    shutil.rmtree(former, ignore_errors=True)


def former_folder(folder: Path) -> Path:
    """Return where the former folder is while :func:`replace_folder` exchanges it."""
    return folder.with_name(f".{folder.name}.former")
