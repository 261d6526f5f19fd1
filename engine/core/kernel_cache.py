"""Which process compiles a kernel: the first that needs it, while the others wait for what it keeps.

Nothing here decides about the code itself, so that the text of this module does not count among the sources
that the code is made of.
"""

import gc
import os
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from octasplat.engine.core.compiling import begin_compilation, end_compilation
from octasplat.engine.core.kernel_folder import PACKAGE, code_folder, readable_code_folder, source_digest

# Read by numba as it is imported: coloring messages of overloads that do not fit takes time.
os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")

from numba.core.caching import CacheImpl, FunctionCache, IndexDataCacheFile, _CacheLocator

try:
    import fcntl
except ImportError:  # on Windows each process compiles for itself
    fcntl = None  # type: ignore[assignment]


class _SharedCache(FunctionCache):  # type: ignore[misc]
    """Code of a kernel on the disk, with a lock for whoever compiles it.

    Numba calls it with its lock of the compiler held, so that one thread of a process is here at a time.
    """

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        self._lock: IO[bytes] | None = None
        self._is_compiling = False
        folder = readable_code_folder(function.__module__)
        self._readable_file: IndexDataCacheFile | None = None
        if folder is not None:
            self._readable_file = IndexDataCacheFile(
                str(folder), self._impl.filename_base, self._impl.locator.get_source_stamp()
            )

    @property
    def _lock_path(self) -> Path:
        return Path(self._cache_file._index_path).with_suffix(".lock")

    def is_being_compiled(self) -> bool:
        """Return whether another process compiles the kernel."""
        if fcntl is None:
            return False
        try:
            with self._lock_path.open("ab") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except OSError:
            return False
        return False

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        found = super().load_overload(sig, target_context)
        if found is not None or self._is_compiling:
            return found
        # Until the code is kept: who waits for the lock finds it then.
        self._is_compiling = True
        _pause_collector()
        begin_compilation()
        self._take_lock()
        # Again, now with the lock: another process may have kept the code while this one waited for it.
        return super().load_overload(sig, target_context)

    def _load_overload(self, sig: Any, target_context: Any) -> Any:
        found = super()._load_overload(sig, target_context)
        if found is not None or self._readable_file is None:
            return found
        try:
            data = self._readable_file.load(self._index_key(sig, target_context.codegen()))
        except OSError:  # kept for another user alone
            return None
        return None if data is None else self._impl.rebuild(target_context, data)

    def release(self) -> None:
        """End what :meth:`load_overload` began, whether the code was made or not."""
        if not self._is_compiling:
            return
        self._is_compiling = False
        # The file stays: were it removed, two processes could hold locks on different files of this name.
        if self._lock is not None:
            self._lock.close()
            self._lock = None
        _resume_collector()
        end_compilation()

    def _take_lock(self) -> None:
        if fcntl is None:
            return
        with suppress(OSError):  # without a lock, the code is made twice
            file = self._lock_path.open("ab")
            self._lock = file
            fcntl.flock(file, fcntl.LOCK_EX)


_PAUSE_LOCK = threading.Lock()
_pauses = 0
_was_collecting = True


def _pause_collector() -> None:
    global _pauses, _was_collecting
    with _PAUSE_LOCK:
        if _pauses == 0:
            _was_collecting = gc.isenabled()
            gc.disable()
        _pauses += 1


def _resume_collector() -> None:
    global _pauses
    with _PAUSE_LOCK:
        _pauses -= 1
        if _pauses == 0 and _was_collecting:
            gc.enable()


def share_compilation(dispatcher: Any) -> Any:
    """Let processes that need this kernel compile it once, with pauses of the garbage collection; return it.

    A compilation makes millions of objects that live to its end; looking through them takes a fifth of it.
    """
    cache = _SharedCache(dispatcher.py_func)
    dispatcher._cache = cache  # in place of the one that cache=True gave it
    compile_overload: Callable[[Any], Any] = dispatcher.compile

    def compile_once(signature: Any) -> Any:
        try:
            return compile_overload(signature)
        # Also after a failed compilation, or other processes would wait until this one ends.
        finally:
            cache.release()

    dispatcher.compile = compile_once
    return dispatcher


class _ContentLocator(_CacheLocator):  # type: ignore[misc]
    """Places the machine code of this package's kernels by the content of their sources."""

    def __init__(self, py_func: Any, py_file: str) -> None:
        self._line = py_func.__code__.co_firstlineno
        self._digest = source_digest(py_func.__module__)
        self._path = code_folder(py_func.__module__)

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


# First of all, as numba takes the first locator that answers
CacheImpl._locator_classes.insert(0, _ContentLocator)
