"""The plan of a scene in blocks: what each trains and for how long, in one file beside the pieces."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from octasplat.engine.blocks.block_plan import Block
from octasplat.engine.blocks.partition import Box
from octasplat.engine.core import versions
from octasplat.engine.core.archive_damage import ARCHIVE_DAMAGE
from octasplat.engine.core.errors import CheckpointError
from octasplat.engine.core.writing import atomic_replace
from octasplat.engine.dataset.view_tiles import Rectangles

PLAN_FILE = "plan.npz"
COARSE, POLISH, FINISH = "coarse", "polish", "finish"
_UNSTATED_RESULTS = 10
"""Results version of plans that do not state theirs, as those before did not."""


@dataclass(frozen=True, eq=False)
class ScenePlan:
    """A scene cut into blocks, by its coarse scene.

    Attributes:
        blocks: in their order in the merged scene.
        iterations: of each block's training; 0 keeps its coarse Gaussians.
        coarse_iterations: those of the coarse scene.
        last_iterations: those of the last piece; of the polish a guess.
        most_gaussians: of any block; None for no such limit.
        is_finished_together: whether one training holds all blocks in the end, see
            :func:`octasplat.engine.blocks.piece_settings.fits_together`.
        results: :data:`octasplat.engine.core.versions.RESULTS_VERSION` of the version that made it.
    """

    blocks: tuple[Block, ...]
    iterations: tuple[int, ...]
    coarse_iterations: int
    last_iterations: int
    most_gaussians: int | None
    is_finished_together: bool
    results: int = field(default_factory=lambda: versions.RESULTS_VERSION)

    @property
    def last_piece(self) -> str:
        """Return the name of the piece that follows the blocks."""
        return FINISH if self.is_finished_together else POLISH

    @property
    def block_names(self) -> tuple[str, ...]:
        """Return the names of the blocks that are trained or kept, in order."""
        return tuple(block_name(number) for number in range(1, len(self.blocks) + 1))

    def expected_iterations(self) -> dict[str, int]:
        """Return the iterations of all pieces, in their order."""
        blocks = dict(zip(self.block_names, self.iterations, strict=True))
        return {COARSE: self.coarse_iterations, **blocks, self.last_piece: self.last_iterations}


def block_name(number: int) -> str:
    """Return the name of a block, numbered from 1, and of its folder.

    >>> block_name(3)
    'block_003'
    """
    return f"block_{number:03d}"


def has_plan(folder: Path) -> bool:
    """Return whether a folder of pieces has a plan."""
    return (folder / PLAN_FILE).exists()


def save_plan(plan: ScenePlan, folder: Path) -> None:
    """Write a plan to the folder of the pieces."""
    pixels = [block.pixels for block in plan.blocks]
    arrays: Mapping[str, np.ndarray] = {
        "low_world": np.stack([block.core.low_world for block in plan.blocks]),
        "high_world": np.stack([block.core.high_world for block in plan.blocks]),
        "margin_world": np.stack([block.margin_world for block in plan.blocks]),
        "share": np.array([block.share for block in plan.blocks], np.float64),
        "iterations": np.array(plan.iterations, np.int64),
        # rectangles of all blocks, one block after the other
        "rectangles": np.array([len(found) for found in pixels], np.int64),
        "view": np.concatenate([found.view for found in pixels]),
        "corner_px": np.concatenate([found.corner_px for found in pixels]),
        "size_px": np.concatenate([found.size_px for found in pixels]),
        "frequency": np.concatenate([found.frequency for found in pixels]),
        "results": np.array(plan.results, np.int64),
        "scene": np.array(
            [
                plan.coarse_iterations,
                plan.last_iterations,
                plan.most_gaussians or 0,
                plan.is_finished_together,
            ],
            np.int64,
        ),
    }
    with atomic_replace(folder / PLAN_FILE) as temporary:
        np.savez(temporary, **arrays)  # type: ignore[arg-type]


def load_plan_to_train(folder: Path) -> ScenePlan:
    """Read the plan of blocks that are to be trained.

    Raises:
        CheckpointError: the file is missing or damaged, or of a version with other results.
    """
    plan = load_plan(folder)
    if plan.results != versions.RESULTS_VERSION:
        raise CheckpointError(
            f"The blocks in {folder} were planned by a version in which the same settings gave other "
            "results; go on with that version, or train again in another folder."
        )
    return plan


def load_plan(folder: Path) -> ScenePlan:
    """Read what :func:`save_plan` wrote.

    Raises:
        CheckpointError: the file is missing or damaged.
    """
    path = folder / PLAN_FILE
    try:
        with path.open("rb") as handle, np.load(handle, allow_pickle=False) as archive:
            found = {name: archive[name] for name in archive.files}
        ends = np.cumsum(found["rectangles"])
        names = ("view", "corner_px", "size_px", "frequency")
        parts = zip(*(np.split(found[name], ends[:-1]) for name in names), strict=True)
        blocks = tuple(
            Block(Box(low, high), margin, float(share), Rectangles(*part))
            for low, high, margin, share, part in zip(
                found["low_world"], found["high_world"], found["margin_world"], found["share"], parts,
                strict=True,
            )
        )  # fmt: skip
        coarse, last, most, together = found["scene"].tolist()
        results = int(found["results"]) if "results" in found else _UNSTATED_RESULTS
        return ScenePlan(
            blocks, tuple(found["iterations"].tolist()), coarse, last, most or None, bool(together), results
        )
    except (*ARCHIVE_DAMAGE, IndexError) as error:
        raise CheckpointError(f"{path} cannot be read ({error}); train again without --resume.") from None
