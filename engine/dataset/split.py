"""Split of the photographs into training views and held-out test views."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from octasplat.engine.core.errors import ConfigError, DatasetError
from octasplat.engine.core.relative_paths import normalize_name
from octasplat.engine.core.writing import write_json


def split_views(
    names: Sequence[str],
    test_every: int = 8,
    held_out: Sequence[str] | None = None,
    *,
    source_name: str = "model",
    burst_length: int = 1,
    duplicates: Sequence[Sequence[int]] = (),
) -> tuple[Int64[np.ndarray, " train"], Int64[np.ndarray, " test"]]:
    """Return the indices of the training views and of the held-out views.

    Args:
        names: names of the views, sorted.
        test_every: hold out every N-th view, starting with the first; 0 holds out none.
        held_out: names of the views to hold out instead; an umlaut may be spelt as one character or as two.
        source_name: what the names are of, for complaints.
        burst_length: so many names that follow each other count as one, and fall on one side.
        duplicates: groups of views that count as one, and fall on one side.

    Raises:
        DatasetError: a name in ``held_out`` is unknown, or nothing is left to train on.
        ConfigError: ``test_every`` is negative.

    >>> train, test = split_views([f"{k:03d}.jpg" for k in range(10)], test_every=4)
    >>> train.tolist(), test.tolist()
    ([1, 2, 3, 5, 6, 7, 9], [0, 4, 8])
    """
    if test_every < 0:
        raise ConfigError(f"test_every is {test_every}; it must be 0 (hold out none) or more.")
    unit = _split_units(len(names), burst_length, duplicates)
    if held_out is not None:
        chosen = set(map(normalize_name, held_out))
        unknown = sorted(chosen - set(map(normalize_name, names)))
        if unknown:
            raise DatasetError(
                f"{len(unknown)} of the images to hold out are not in the {source_name} "
                f"({', '.join(unknown[:3])}); give names as they stand there."
            )
        is_chosen = np.array([normalize_name(name) in chosen for name in names], dtype=bool)
        # A view that shares a unit with a chosen one is held out with it.
        is_test = np.isin(unit, unit[is_chosen])
    else:
        is_test = unit % test_every == 0 if test_every else np.zeros(len(names), dtype=bool)
    if is_test.all():
        raise DatasetError(f"All {len(names)} images are held out; leave some to train on.")
    return np.flatnonzero(~is_test).astype(np.int64), np.flatnonzero(is_test).astype(np.int64)


def _split_units(
    count: int, burst_length: int, duplicates: Sequence[Sequence[int]]
) -> Int64[np.ndarray, " n"]:
    """Return the number of the unit that each of ``count`` views belongs to, by the first view of each."""
    unit = np.arange(count, dtype=np.int64) // burst_length
    for group in duplicates:
        together = np.unique(unit[list(group)])
        unit[np.isin(unit, together)] = together[0]
    # Numbered without gaps, as every N-th unit is held out
    return np.unique(unit, return_inverse=True)[1].astype(np.int64)


def evaluation_split(
    names: Sequence[str],
) -> tuple[Int64[np.ndarray, " train"], Int64[np.ndarray, " test"]]:
    """Return the split for photographs that are only evaluated: no training views, all held out.

    >>> train, test = evaluation_split(["a.jpg", "b.jpg"])
    >>> train.tolist(), test.tolist()
    ([], [0, 1])
    """
    return np.zeros(0, np.int64), np.arange(len(names), dtype=np.int64)


def write_held_out(path: Path, names: Sequence[str]) -> None:
    """Write the names of the held-out views to ``path`` as a JSON list, atomically."""
    write_json(path, list(names))
