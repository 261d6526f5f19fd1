"""Types of arrays that the functions of the package accept."""

from collections.abc import Sequence
from typing import Any

from numpy.typing import NDArray

Numbers = Sequence[float] | NDArray[Any]
"""Numbers in a row, such as a point: a list, a tuple or an array."""
Matrix = Sequence[Numbers] | NDArray[Any]
"""Rows of numbers: lists, tuples or an array."""
