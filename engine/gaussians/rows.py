"""Row tables, dataclasses of arrays with one row per Gaussian, and operations on all their arrays.

A table is a dataclass whose fields are arrays with a row for every Gaussian, named channels, or things that
have no rows. No operation lists fields, so that none can forget one.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import Field, fields, replace
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Bool

from octasplat.engine.core.file_arrays import new_array
from octasplat.engine.gaussians.channels import Channels

RowIndex = np.ndarray | slice
COPIED_ROWS = 16384
"""At a time, where a copy is in files."""


@runtime_checkable
class RowTable(Protocol):
    """A dataclass whose fields are arrays with one row for each Gaussian."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


TableT = TypeVar("TableT", bound=RowTable)


def row_arrays(table: RowTable) -> dict[str, np.ndarray]:
    """Return every array of a table by its field's name; a channel is called ``channels.<name>``."""
    arrays: dict[str, np.ndarray] = {}
    for field in fields(table):
        value = getattr(table, field.name)
        if isinstance(value, Channels):
            arrays |= {f"{field.name}.{name}": array for name, array in value.items()}
        elif isinstance(value, np.ndarray):
            arrays[field.name] = value
    return arrays


def from_row_arrays(kind: Callable[..., TableT], arrays: Mapping[str, np.ndarray]) -> TableT:
    """Return a table of the arrays that :func:`row_arrays` returned; other fields have their defaults."""
    values: dict[str, Any] = {}
    channels: dict[str, dict[str, np.ndarray]] = {}
    for name, array in arrays.items():
        field, dot, channel = name.partition(".")
        if dot:
            channels.setdefault(field, {})[channel] = array
        else:
            values[field] = array
    return kind(**values, **{field: Channels(named) for field, named in channels.items()})


def map_rows(table: TableT, function: Callable[[np.ndarray], np.ndarray]) -> TableT:
    """Return the table with ``function`` applied to each array; other fields are kept."""
    changes: dict[str, Any] = {}
    for field in fields(table):
        value = getattr(table, field.name)
        if isinstance(value, Channels):
            changes[field.name] = value.map(function)
        elif isinstance(value, np.ndarray):
            changes[field.name] = function(value)
    return replace(table, **changes)


def select_rows(table: TableT, index: RowIndex) -> TableT:
    """Return a copy of the rows at ``index`` (integers, a mask or a slice)."""
    return map_rows(table, lambda array: array[index].copy())


def allocate_rows(table: TableT, count: int, folder: Path | None = None) -> TableT:
    """Return a table with the columns of another and so many rows, not filled yet; with a folder in files."""
    return map_rows(table, lambda array: new_array((count, *array.shape[1:]), array.dtype, folder))


def select_into_files(table: TableT, mask: Bool[np.ndarray, " n"], folder: Path) -> TableT:
    """Return a copy of the rows in a mask, in files in a folder, some thousands copied at a time.

    Raises:
        DiskFullError: there is no room for the files.
    """
    rows = np.flatnonzero(mask)
    found = allocate_rows(table, len(rows), folder)
    for start in range(0, len(rows), COPIED_ROWS):
        part = slice(start, start + COPIED_ROWS)
        overwrite_rows(found, part, select_rows(table, rows[part]))
    return found


def view_rows(table: TableT, part: slice) -> TableT:
    """Return the rows of a slice, not copied."""
    return map_rows(table, lambda array: array[part])


def overwrite_rows(table: RowTable, index: RowIndex, other: RowTable) -> None:
    """Overwrite the rows at ``index`` by all rows of ``other``, in place.

    Raises:
        ValueError: the tables do not have the same arrays.
    """
    arrays, values = row_arrays(table), row_arrays(other)
    _check_same_arrays([arrays, values])
    for name, array in arrays.items():
        array[index] = values[name]


def concatenate_rows(parts: Sequence[TableT]) -> TableT:
    """Return all rows of ``parts``, in order; other fields are those of the first.

    Raises:
        ValueError: the parts do not have the same arrays.
    """
    every = [row_arrays(part) for part in parts]
    _check_same_arrays(every)
    joined = {name: np.concatenate([arrays[name] for arrays in every]) for name in every[0]}
    table = from_row_arrays(type(parts[0]), joined)
    others = {
        field.name: getattr(parts[0], field.name)
        for field in fields(parts[0])
        if not isinstance(getattr(parts[0], field.name), np.ndarray | Channels)
    }
    return replace(table, **others)


def _check_same_arrays(every: Sequence[Mapping[str, np.ndarray]]) -> None:
    for arrays in every[1:]:
        if arrays.keys() != every[0].keys():
            odd = ", ".join(sorted(arrays.keys() ^ every[0].keys()))
            raise ValueError(f"some parts have {odd} and others have not")
