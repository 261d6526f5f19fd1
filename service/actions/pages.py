"""Pages of long lists."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

Row = TypeVar("Row")


@dataclass(frozen=True)
class Page(Generic[Row]):
    """A page of a long list.

    Attributes:
        rows: its entries.
        next_key: the place of the last of them, after which the next part begins; None at the end.
    """

    rows: list[Row]
    next_key: str | None


def page_of(rows_found: Sequence[Row], limit: int, key_of: Callable[[Row], object]) -> Page[Row]:
    """Return the first ``limit`` rows as a page; one row too many shows that there are more."""
    rows = list(rows_found[:limit])
    return Page(rows, str(key_of(rows[-1])) if len(rows_found) > limit else None)
