"""What is done to one array of a table is done to all, whatever fields it has."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.gaussians import rows
from octasplat.engine.gaussians.channels import Channels
from octasplat.engine.gaussians.rows import (
    concatenate_rows,
    from_row_arrays,
    map_rows,
    overwrite_rows,
    row_arrays,
    select_rows,
)


@dataclass
class Table:
    places: np.ndarray
    weights: np.ndarray
    notes: tuple[str, ...] = ()
    channels: Channels = field(default_factory=Channels)


def table(start: int, count: int) -> Table:
    numbers = np.arange(start, start + count, dtype=np.float32)
    return Table(
        np.stack([numbers, -numbers], axis=1), 2 * numbers, ("kept",), Channels({"label": numbers[:, None]})
    )


def assert_rows(found: Table, numbers: list[int]) -> None:
    wanted = np.array(numbers, np.float32)
    np.testing.assert_array_equal(found.places, np.stack([wanted, -wanted], axis=1))
    np.testing.assert_array_equal(found.weights, 2 * wanted)
    np.testing.assert_array_equal(found.channels["label"][:, 0], wanted)
    assert found.notes == ("kept",)


def test_rows_are_selected_joined_and_overwritten_together() -> None:
    first, second = table(0, 5), table(10, 3)
    chosen = select_rows(first, np.array([4, 0, 0]))
    assert_rows(chosen, [4, 0, 0])
    chosen.weights[:] = 7
    assert_rows(first, [0, 1, 2, 3, 4])
    assert_rows(concatenate_rows([second, first]), [10, 11, 12, 0, 1, 2, 3, 4])
    overwrite_rows(first, np.array([3, 1]), select_rows(second, slice(2)))
    assert_rows(first, [0, 11, 2, 10, 4])
    assert_rows(map_rows(second, lambda array: array[::-1]), [12, 11, 10])


def test_rows_are_selected_into_files_without_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rows, "COPIED_ROWS", 2)
    chosen = rows.select_into_files(table(0, 7), np.array([1, 0, 1, 1, 0, 1, 1], np.bool_), tmp_path)
    assert_rows(chosen, [0, 2, 3, 5, 6])
    overwrite_rows(chosen, slice(1, 2), table(10, 1))
    assert_rows(chosen, [0, 10, 3, 5, 6])
    assert list(tmp_path.iterdir()) == []
    assert len(rows.select_into_files(chosen, np.zeros(5, np.bool_), tmp_path).weights) == 0


def test_arrays_by_name_and_back() -> None:
    arrays = row_arrays(table(0, 4))
    assert list(arrays) == ["places", "weights", "channels.label"]
    back = from_row_arrays(Table, arrays)
    assert back.notes == () and back.channels.widths == {"label": 1}


def test_mismatched_tables_are_refused() -> None:
    bare = Table(np.zeros((2, 2)), np.zeros(2))
    for mix in (
        lambda: concatenate_rows([table(0, 2), bare]),
        lambda: overwrite_rows(table(0, 2), slice(2), bare),
    ):
        with pytest.raises(ValueError, match=r"some parts have channels\.label and others have not"):
            mix()
