"""Folder that an untrusted program writes, read without following what that program has put into it.

Names are opened one part after another, each relative to the folder before it and without following links
(``O_NOFOLLOW``), so that nothing outside is opened whatever is renamed or replaced meanwhile. What is opened
is a regular file all of whose names lie inside the folder: no link, pipe or device, and no further name of a
file elsewhere.
"""

import errno
import os
import stat
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

from octasplat.workers.storage.errors import UntrustedFileError
from octasplat.workers.storage.os_errors import translate_os_errors

_FOLDER_FLAGS = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
_FILE_FLAGS = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
"""A pipe would otherwise keep the reader waiting for somebody who writes."""
_NOT_A_FILE = frozenset({errno.ELOOP, errno.ENOTDIR, errno.EMLINK, errno.ENXIO, errno.EISDIR})
"""Answers for links (EMLINK on some BSDs), sockets, and files in the place of folders."""
MAX_DEPTH = 64
"""Of folders in each other: each takes a descriptor of its reader and a part of its stack."""


class UntrustedFolder:
    """Reads files below a folder; use it as a context manager.

    Args:
        path: the folder; only what is below it is untrusted.

    Raises:
        StorageUnavailableError: it is not a folder that can be opened.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._links: Counter[tuple[int, int]] | None = None
        with translate_os_errors(path):
            self._fd = os.open(path, _FOLDER_FLAGS)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._fd)

    def open(self, name: str) -> BinaryIO:
        """Open a file for reading.

        Args:
            name: of the file, relative to the folder, with forward slashes.

        Raises:
            StorageUnavailableError: it is not there, or cannot be read.
            UntrustedFileError: it is not a regular file of this folder alone.
        """
        path = self.path / name
        with translate_os_errors(path):
            try:
                fd = self._open_beneath(name, _FILE_FLAGS)
            except OSError as error:
                if error.errno in _NOT_A_FILE:
                    raise _refusal(path) from error
                raise
        try:
            facts = os.fstat(fd)
            if not stat.S_ISREG(facts.st_mode) or self._has_names_elsewhere(facts):
                raise _refusal(path)
            return os.fdopen(fd, "rb")
        except BaseException:
            os.close(fd)
            raise

    def is_file(self, name: str) -> bool:
        """Return whether :meth:`open` would find a regular file, whoever else has a name for it."""
        try:
            fd = self._open_beneath(name, _FILE_FLAGS)
        except OSError:
            return False
        try:
            return stat.S_ISREG(os.fstat(fd).st_mode)
        finally:
            os.close(fd)

    def state(self, name: str) -> tuple[int, ...] | None:
        """Return what tells a folder from one that takes its place, or that gets other files; None for none.

        Args:
            name: of the folder, relative to this one.
        """
        try:
            fd = self._open_beneath(name, _FOLDER_FLAGS)
        except OSError:
            return None
        try:
            facts = os.fstat(fd)
            return facts.st_dev, facts.st_ino, facts.st_mtime_ns
        finally:
            os.close(fd)

    def remove(self, name: str) -> None:
        """Remove a file, if it is there, or the link that is in its place."""
        parent, _, last = name.rpartition("/")
        with suppress(OSError):
            fd = self._open_beneath(parent, _FOLDER_FLAGS) if parent else os.dup(self._fd)
            try:
                os.unlink(last, dir_fd=fd)
            finally:
                os.close(fd)

    def names(self, below: str = "") -> Iterator[str]:
        """Yield the names of all that is below a folder but folders, relative to that folder.

        Args:
            below: the folder, relative to this one; where there is none of that name, there are no files.

        Raises:
            UntrustedFileError: the name is that of a link or a file, or a folder below it cannot be read.
        """
        try:
            fd = self._open_beneath(below, _FOLDER_FLAGS) if below else os.dup(self._fd)
        except FileNotFoundError:
            return
        except OSError as error:
            raise _refusal(self.path / below, "a folder") from error
        try:
            for folder, files, _ in self._walk(fd, below):
                inner = folder.removeprefix(below).removeprefix("/")
                yield from (f"{inner}/{name}" if inner else name for name in files)
        finally:
            os.close(fd)

    def disk_usage_bytes(self, *, leave_out: str) -> int:
        """Return what the files take on the disk, each once.

        Args:
            leave_out: name of a folder directly below that does not count.

        Raises:
            UntrustedFileError: a folder cannot be read, so that what is in it is not known.
        """
        blocks: dict[int, int] = {}
        for _, files, fd in self._walk(self._fd, leave_out=leave_out):
            for name in files:
                with suppress(FileNotFoundError):
                    facts = os.stat(name, dir_fd=fd, follow_symlinks=False)
                    blocks[facts.st_ino] = facts.st_blocks
        return 512 * sum(blocks.values())

    def _walk(
        self, fd: int, below: str = "", depth: int = 0, leave_out: str = ""
    ) -> Iterator[tuple[str, list[str], int]]:
        """Yield each folder: its name relative to this one, the names in it that are no folders, and itself.

        Raises:
            UntrustedFileError: a folder cannot be read, or lies too deep.
            StorageUnavailableError: the system cannot do it.
        """
        folders: list[str] = []
        files: list[str] = []
        with translate_os_errors(self.path / below), os.scandir(fd) as entries:
            for entry in entries:
                (folders if entry.is_dir(follow_symlinks=False) else files).append(entry.name)
        yield below, files, fd
        for name in folders:
            inner = f"{below}/{name}" if below else name
            if inner == leave_out:
                continue
            if depth == MAX_DEPTH:
                raise _refusal(self.path / inner, f"among the first {MAX_DEPTH} folders in each other")
            with translate_os_errors(self.path / inner):
                try:
                    inner_fd = os.open(name, _FOLDER_FLAGS, dir_fd=fd)
                except PermissionError as error:
                    raise _refusal(self.path / inner, "a folder that can be read") from error
                except OSError as error:
                    if error.errno in (errno.ENOENT, *_NOT_A_FILE):
                        continue  # gone or replaced this moment
                    raise
            try:
                yield from self._walk(inner_fd, inner, depth + 1, leave_out)
            finally:
                os.close(inner_fd)

    def _open_beneath(self, name: str, flags: int) -> int:
        """Open what is called ``name``, part by part.

        Raises:
            OSError: it is not there, or a part of the name is a link or leads elsewhere.
        """
        parts = name.split("/")
        if any(part in ("", ".", "..") or "\0" in part for part in parts):
            # Refused as links are: the name leads elsewhere, or nowhere.
            raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), name)
        folder = os.dup(self._fd)
        try:
            for part in parts[:-1]:
                inner = os.open(part, _FOLDER_FLAGS, dir_fd=folder)
                os.close(folder)
                folder = inner
            return os.open(parts[-1], flags, dir_fd=folder)
        finally:
            os.close(folder)

    def _has_names_elsewhere(self, facts: os.stat_result) -> bool:
        """Return whether a file has more names than this folder holds."""
        if facts.st_nlink <= 1:
            return False
        if self._links is None:
            self._links = self._count_names()
        return facts.st_nlink > self._links[facts.st_dev, facts.st_ino]

    def _count_names(self) -> Counter[tuple[int, int]]:
        found: Counter[tuple[int, int]] = Counter()
        for _, files, fd in self._walk(self._fd):
            for name in files:
                with suppress(FileNotFoundError):
                    facts = os.stat(name, dir_fd=fd, follow_symlinks=False)
                    found[facts.st_dev, facts.st_ino] += 1
        return found


def _refusal(path: Path, what: str = "a regular file of its folder alone") -> UntrustedFileError:
    return UntrustedFileError(f"{path} is not {what} and cannot be stored.")
