"""Levels of detail of a scene: each has half the Gaussians of the one before, by merging neighbors."""

from collections.abc import Iterator
from pathlib import Path

from octasplat.engine.gaussians.model import FlatGaussians


def level_counts(count: int, fewest: int) -> list[int]:
    """Return how many Gaussians each level of a scene has, the finest first.

    Args:
        count: of the scene, 1 at least.
        fewest: that a level may have; a scene of less than twice as many has one level.

    >>> level_counts(100, 20), level_counts(30, 20)
    ([100, 50, 25], [30])
    """
    counts = [count]
    while counts[-1] >= 2 * fewest:
        counts.append(counts[-1] // 2)
    return counts


def iterate_levels(
    scene: FlatGaussians, fewest: int, folder: Path, most: int | None = None
) -> Iterator[FlatGaussians]:
    """Yield the levels of a scene, itself first; only one is held at a time, the coarser ones in files.

    Args:
        scene: the finest level.
        fewest: Gaussians that a level may have, as in :func:`level_counts`.
        folder: for files that are gone when nobody holds their level. It must outlast the levels: of a file
            that is held something stays in its folder on NFS, so that this cannot be removed.
        most: levels, None for all that there are.

    Raises:
        DiskFullError: there is no room for the files.
    """
    # imported late: the table of formats is read where nothing is written, too
    from octasplat.engine.gaussians.simplification import simplify

    for count in level_counts(len(scene), fewest)[:most]:
        scene = simplify(scene, count, folder=folder)
        yield scene
