"""Long lists in parts."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

Row = TypeVar("Row")


@dataclass(frozen=True)
class Part(Generic[Row]):
    """A part of a long list.

    Attributes:
        rows: its entries.
        following: the place of the last of them, after which the next part begins; None at the end.
    """

    rows: list[Row]
    following: str | None


def cut(found: Sequence[Row], limit: int, place: Callable[[Row], object]) -> Part[Row]:
    """The first ``limit`` of what was found; that there is more shows in one entry too many."""
    rows = list(found[:limit])
    return Part(rows, str(place(rows[-1])) if len(found) > limit else None)
