"""The run-time type checker of the tests, and which calls it checks.

To check a call takes a tenth of a millisecond, which makes inner loops many times as slow. Of each function
the first calls of a test are checked, and fewer and fewer of those that follow.
"""

import functools
import inspect
import sys
import threading
from collections.abc import Callable
from dataclasses import is_dataclass
from typing import Any

import jaxtyping
from beartype import BeartypeConf, beartype

CHECKED_CALLS = 8
"""Calls of each function that are checked in each test; of later ones, the 16th, the 32nd and so on."""

# As for any static checker, an int is good where a float is asked for.
check = beartype(conf=BeartypeConf(is_pep484_tower=True))

_check_all_calls: Callable[..., Any] = jaxtyping.jaxtyped
_LOCK = threading.RLock()
_test = 0


def begin_test() -> None:
    """Check the first calls of each function again."""
    global _test
    _test += 1


def is_checked(call: int) -> bool:
    """Return whether the ``call``-th call of a function in a test is checked, counted from 1."""
    return call <= CHECKED_CALLS or not call & (call - 1)


def check_some_calls(checked: Any = None, *, typechecker: Any) -> Any:
    """Decorate a function or a class as ``jaxtyping.jaxtyped``, but check some calls only.

    The checks of a function are made when it is first called.
    """
    if checked is None:
        return functools.partial(check_some_calls, typechecker=typechecker)
    if not inspect.isclass(checked):
        return _check_some_calls_of(checked, typechecker)
    # A method that stands in the class is decorated itself; what dataclass writes is not.
    if is_dataclass(checked) and not hasattr(checked.__init__, "__wrapped__"):
        checked.__init__ = _check_some_calls_of(checked.__init__, typechecker)
    return checked


def _check_some_calls_of(function: Callable[..., Any], typechecker: Any) -> Callable[..., Any]:
    with_checks: Callable[..., Any] | None = None
    test = calls = 0

    @functools.wraps(function)
    def sometimes_checked(*arguments: Any, **named: Any) -> Any:
        nonlocal with_checks, test, calls
        if test != _test:
            test, calls = _test, 0
        calls += 1
        if not is_checked(calls) or sys.is_finalizing():
            return function(*arguments, **named)
        if with_checks is None:
            with _LOCK:
                with_checks = _check_all_calls(function, typechecker=typechecker)
        return with_checks(*arguments, **named)

    return sometimes_checked


def install(modules: list[str]) -> None:
    """Check what functions of these modules, none of them imported yet, take and return."""
    jaxtyping.jaxtyped = check_some_calls  # which the decorators call that the hook adds
    jaxtyping.install_import_hook(modules, f"{__name__}.check")
