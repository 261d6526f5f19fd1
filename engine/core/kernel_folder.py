"""Where the machine code of kernels is kept: by the content of the sources that it is made of.

A reinstallation, another checkout or another environment finds the code, and a changed source never meets
old code. This module imports no numba, so that a front end can ask whether kernels are compiled.
"""

import hashlib
import importlib.util
import logging
import os
import re
import stat
import sys
import tempfile
from functools import cache
from importlib.metadata import version
from pathlib import Path

LOG = logging.getLogger("octasplat")
PACKAGE = __name__.partition(".")[0]
CACHE_VARIABLE = "NUMBA_CACHE_DIR"
_NOT_IN_THE_CODE = {
    f"{PACKAGE}.engine.core.{name}" for name in ("kernel_cache", "kernel_folder", "compiling")
}
"""Modules that keep machine code and decide nothing about it."""
# Imports are found in the text, as importing the modules would import numba.
_IMPORT = re.compile(
    rf"^\s*(?:from\s+({PACKAGE}[\w.]*)\s+import\s+(\([^)]*\)|[^\n(]+)|import\s+({PACKAGE}[\w.]+))",
    re.MULTILINE,
)


@cache
def _package_folder(package: str) -> Path | None:
    spec = importlib.util.find_spec(package)
    locations = None if spec is None else spec.submodule_search_locations
    return Path(next(iter(locations))) if locations else None


def _is_module(package: str, name: str) -> bool:
    folder = _package_folder(package) if package else None
    return folder is not None and (folder / f"{name}.py").is_file()


@cache
def _source(module: str) -> tuple[bytes, tuple[str, ...]]:
    """Return the digest of a module's source, and the modules of the package that it imports."""
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        return b"", ()
    content = Path(spec.origin).read_bytes()
    imported: set[str] = set()
    for package, names, whole in _IMPORT.findall(content.decode()):
        imported.add(package or whole)
        # A name may be a module of the package, which then counts itself.
        imported |= {f"{package}.{name}" for name in re.findall(r"\w+", names) if _is_module(package, name)}
    return hashlib.sha256(content).digest(), tuple(sorted(imported))


@cache
def source_digest(module: str) -> str:
    """Return a digest of the sources of ``module`` and of all modules of the package that it imports."""
    seen: set[str] = set()
    todo = [module]
    while todo:
        name = todo.pop()
        if name not in seen and name not in _NOT_IN_THE_CODE:
            seen.add(name)
            todo.extend(_source(name)[1])
    total = hashlib.sha256()
    for name in sorted(seen):
        total.update(name.encode() + b"\0" + _source(name)[0])
    return total.hexdigest()[:20]


def _is_usable(folder: Path) -> bool:
    """Return whether this process, and nobody else but root, may keep code in ``folder``."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Only writing shows whether it works: the permissions say nothing of a file system mounted read-only.
        with tempfile.TemporaryFile(dir=folder):
            pass
        owner = folder.stat()
    except OSError:
        return False
    if not hasattr(os, "getuid"):
        return True
    # Kept code is run when it is loaded, so that whoever may write here could have this process run theirs.
    return owner.st_uid in (0, os.getuid()) and not owner.st_mode & stat.S_IWOTH


def shared_cache_folder() -> Path:
    """Return the folder that processes of this user share: ``NUMBA_CACHE_DIR``, or in the user's cache."""
    from platformdirs import user_cache_path

    return Path(named) if (named := os.environ.get(CACHE_VARIABLE)) else user_cache_path(PACKAGE) / "kernels"


@cache
def cache_folder() -> Path:
    """Return the folder in which this process keeps the machine code of kernels.

    That is :func:`shared_cache_folder`. Where that cannot be written, as in a container with a read-only
    home, in a job's process, or with a ``~/.cache`` of another user, it is a private folder among the
    temporary files, and a warning is logged unless code can be read there (:func:`readable_cache_folder`).
    """
    wanted = shared_cache_folder()
    if _is_usable(wanted):
        return wanted
    user = os.getuid() if hasattr(os, "getuid") else 0
    private = Path(tempfile.gettempdir()) / f"{PACKAGE}-kernels-{user}"
    if not _is_private(private):
        # the name is taken by another user, or open to others
        private = Path(tempfile.mkdtemp(prefix=f"{PACKAGE}-kernels-"))
    if readable_cache_folder() is not None:
        return private
    LOG.warning(
        "compiled kernels cannot be kept in %s, which cannot be written; they are kept in %s."
        " Set %s to a folder that can be written to keep them for good",
        wanted,
        private,
        CACHE_VARIABLE,
    )
    return private


@cache
def readable_cache_folder() -> Path | None:
    """Return the shared folder where this process cannot write it and may trust what it holds, else None."""
    folder = shared_cache_folder()
    try:
        found = folder.stat()
        with os.scandir(folder):
            pass
    except OSError:
        return None
    trusted = not hasattr(os, "getuid") or found.st_uid in (0, os.getuid())
    return folder if trusted and not found.st_mode & stat.S_IWOTH and not _is_usable(folder) else None


@cache
def code_folder(module: str) -> Path:
    """Return the folder in which this process keeps the machine code of a module's kernels."""
    return cache_folder() / _relative_folder(module)


@cache
def readable_code_folder(module: str) -> Path | None:
    """Return where this process only reads machine code of a module's kernels, see :func:`cache_folder`."""
    shared = readable_cache_folder()
    return None if shared is None else shared / _relative_folder(module)


def count_code(module: str, function: str) -> int:
    """Return for how many types of arguments machine code of a kernel is kept where this process looks."""
    pattern = f"{module.rpartition('.')[2]}.{function}-*.nbc"
    folders = (cache_folder(), readable_cache_folder())
    return sum(
        len(list((folder / _relative_folder(module)).glob(pattern)))
        for folder in folders
        if folder is not None
    )


@cache
def _relative_folder(module: str) -> Path:
    versions = f"{sys.implementation.cache_tag}-numba{version('numba')}-llvmlite{version('llvmlite')}"
    return Path(versions) / f"{module.rpartition('.')[2]}-{source_digest(module)}"


def _is_private(folder: Path) -> bool:
    """Make ``folder`` for this user alone; whether it is this user's alone."""
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()  # not stat(): another user may have put a link there
    except OSError:
        return False
    mine = not hasattr(os, "getuid") or found.st_uid == os.getuid()
    return mine and stat.S_ISDIR(found.st_mode) and not found.st_mode & 0o077 and _is_usable(folder)
