"""Values of a parameter of which some run daily, and the others with the tests marked exhaustive."""

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def some_daily(values: Iterable[Any], daily: Collection[Any]) -> list[Any]:
    """Return the values as parameters of a test; those that are not in ``daily`` are marked exhaustive."""
    return [
        pytest.param(
            *(value if isinstance(value, tuple) else (value,)),
            marks=[] if value in daily else [pytest.mark.exhaustive],
        )
        for value in values
    ]
