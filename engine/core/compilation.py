"""Compilation of the kernels, and the cache of their machine code.

Three rules keep the first use of the program short:

- A function that only other kernels call is a :func:`device_function`: it is typed and lowered, and its code
  is generated as part of its callers. It has no wrapper for Python and no machine code of its own.
- A loop over threads whose body is long is a :func:`kernel` that each thread calls (:func:`run_on_threads`).
  Numba's ``prange`` would generate the code of its body three times.
- Machine code is kept by the content of the sources that it is made of, not by path and time stamp, so that a
  reinstallation, another checkout or another environment finds it, and a changed source never meets old code.
"""

import hashlib
import importlib.util
import logging
import os
import re
import stat
import sys
import tempfile
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import numba
from numba import njit
from numba.core.caching import CacheImpl, _CacheLocator
from numba.core.compiler import Compiler

LOG = logging.getLogger("octasplat")
ROWS = 256
"""Rows of an array that are worth a thread: fewer take less time than to wake it."""
PACKAGE = __name__.partition(".")[0]
CACHE_VARIABLE = "NUMBA_CACHE_DIR"
_IMPORT = re.compile(
    rf"^\s*(?:from\s+({PACKAGE}[\w.]*)\s+import\s+(\([^)]*\)|[^\n(]+)|import\s+({PACKAGE}[\w.]+))",
    re.MULTILINE,
)


class _DeviceCompiler(Compiler):  # type: ignore[misc]
    """Types and lowers a function for its callers; makes neither wrappers nor machine code.

    The callers' module takes the code in and optimises all of it once.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        flags = self.state.flags
        flags.no_compile = True
        flags.no_cpython_wrapper = True
        flags.no_cfunc_wrapper = True

    def compile_extra(self, func: Any) -> Any:
        context = self.state.targetctx
        library = context.codegen().create_library(func.__qualname__)
        library._optimize_final_module = lambda: None
        self.state.library = library
        result = super().compile_extra(func)
        # Callers find the code by the identity of a builtin. This one is new, and raises whatever it is
        # called with, as the format asks for a value that nobody gives.
        entry = f"{{{func.__name__} is called by kernels only, not from Python}}".format
        context.insert_user_function(entry, result.fndesc, [result.library])
        return result._replace(entry_point=entry)


def device_function(**options: Any) -> Callable[[Any], Any]:
    """Return a decorator for functions that kernels call and Python does not.

    Args:
        options: as of ``numba.njit``.
    """
    return njit(pipeline_class=_DeviceCompiler, **options)


def kernel(**options: Any) -> Callable[[Any], Any]:
    """Return a decorator for functions that Python calls; options as of ``numba.njit``.

    Their machine code is kept on the disk, see :func:`cache_folder`. They release the interpreter's lock.
    """
    return njit(cache=True, nogil=True, **options)


class _Threads:
    """Pool of waiting threads; as many as were ever requested at once."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pool: ThreadPoolExecutor | None = None
        self._count = 0
        os.register_at_fork(after_in_child=self._forget)

    def _forget(self) -> None:
        self._lock, self._pool, self._count = threading.Lock(), None, 0

    def pool(self, count: int) -> ThreadPoolExecutor:
        with self._lock:
            if self._pool is None or self._count < count:
                self._pool, self._count = ThreadPoolExecutor(count, "kernel"), count
            return self._pool


_THREADS = _Threads()


def _call_all(kernel: Callable[..., None], calls: Sequence[tuple[Any, ...]]) -> None:
    """Make all calls at once, the first on this thread; wait for all, then raise the first error."""
    pool = _THREADS.pool(len(calls) - 1) if len(calls) > 1 else None
    others = [pool.submit(kernel, *arguments) for arguments in calls[1:]] if pool else []
    try:
        kernel(*calls[0])
    finally:
        errors = [error for error in (other.exception() for other in others) if error is not None]
    if errors:
        raise errors[0]


def run_on_threads(kernel: Callable[..., None], threads: int, *arguments: Any) -> None:
    """Call ``kernel(*arguments)`` on ``threads`` threads at once, this one among them; wait for all.

    The calls share their work by a counter among the arguments
    (:func:`octasplat.engine.trace.kernels.native.atomic_fetch_next`).

    Raises:
        Exception: what the first call that failed raised.
    """
    _call_all(kernel, [arguments] * max(1, threads))


def run_ranges(
    kernel: Callable[..., None], threads: int, count: int, *arguments: Any, grain: int = ROWS
) -> None:
    """Call ``kernel(first, last, *arguments)`` on ``threads`` threads, which share the range to ``count``.

    Args:
        kernel: works on the elements ``first`` to ``last``, each by itself.
        threads: how many to take at most.
        count: of the elements; each thread gets an equal share of neighbours.
        arguments: handed on.
        grain: elements that are worth a thread.

    Raises:
        Exception: what the first call that failed raised.
    """
    threads = max(1, min(threads, count // grain))
    ends = [count * k // threads for k in range(threads + 1)]
    _call_all(kernel, [(*ends[k - 1 : k + 1], *arguments) for k in range(1, threads + 1)])


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
    for package, names, module_name in _IMPORT.findall(content.decode()):
        imported.add(package or module_name)
        # A name may be a module of the package, which then counts itself.
        imported |= {f"{package}.{name}" for name in re.findall(r"\w+", names) if _is_module(package, name)}
    return hashlib.sha256(content).digest(), tuple(sorted(imported))


@cache
def source_digest(module: str) -> str:
    """Return a digest of the sources of ``module`` and of all modules of the package that it imports."""
    visited: set[str] = set()
    todo = [module]
    while todo:
        name = todo.pop()
        if name not in visited:
            visited.add(name)
            todo.extend(_source(name)[1])
    total = hashlib.sha256()
    for name in sorted(visited):
        total.update(name.encode() + b"\0" + _source(name)[0])
    return total.hexdigest()[:20]


def _is_usable(folder: Path) -> bool:
    """Return whether this process may store code in ``folder``, and nobody else but root may."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        owner = folder.stat()
    except OSError:
        return False
    if not hasattr(os, "getuid"):
        return True
    return owner.st_uid in (0, os.getuid()) and not owner.st_mode & stat.S_IWOTH


@cache
def cache_folder() -> Path:
    """Return the folder in which this process keeps the machine code of kernels.

    That is ``NUMBA_CACHE_DIR`` where it is set, else the user's cache folder. Where that cannot be written,
    as in a container with a read-only home or with a ``~/.cache`` of another user, it is a private folder
    among the temporary files, and a warning is logged.
    """
    from platformdirs import user_cache_path

    preferred = (
        Path(named) if (named := os.environ.get(CACHE_VARIABLE)) else user_cache_path(PACKAGE) / "kernels"
    )
    if _is_usable(preferred):
        return preferred
    user = os.getuid() if hasattr(os, "getuid") else 0
    private = Path(tempfile.gettempdir()) / f"{PACKAGE}-kernels-{user}"
    if not _is_private(private):
        private = Path(tempfile.mkdtemp(prefix=f"{PACKAGE}-kernels-"))
    LOG.warning(
        "compiled kernels cannot be kept in %s, which cannot be written; they are kept in %s."
        " Set %s to a folder that can be written to keep them for good",
        preferred,
        private,
        CACHE_VARIABLE,
    )
    return private


def _is_private(folder: Path) -> bool:
    """Make ``folder`` for this user alone; whether it is this user's alone."""
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError:
        return False
    mine = not hasattr(os, "getuid") or found.st_uid == os.getuid()
    return mine and stat.S_ISDIR(found.st_mode) and not found.st_mode & 0o077 and _is_usable(folder)


class _ContentLocator(_CacheLocator):  # type: ignore[misc]
    """Places the machine code of this package's kernels by the content of their sources."""

    def __init__(self, py_func: Any, py_file: str) -> None:
        self._module = py_func.__module__
        self._line = py_func.__code__.co_firstlineno
        self._digest = source_digest(self._module)
        versions = f"{sys.implementation.cache_tag}-numba{numba.__version__}-llvmlite{llvmlite.__version__}"
        self._path = cache_folder() / versions / f"{self._module.rpartition('.')[2]}-{self._digest}"

    def get_cache_path(self) -> str:
        return str(self._path)

    def get_source_stamp(self) -> str:
        return self._digest

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> "_ContentLocator | None":
        if not py_func.__module__.startswith(f"{PACKAGE}.") or not Path(py_file).is_file():
            return None
        locator = cls(py_func, py_file)
        locator.ensure_cache_path()
        return locator


CacheImpl._locator_classes.insert(0, _ContentLocator)
