"""Checkpoints of attempts, from which later ones resume."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from octasplat.engine.core import versions
from octasplat.engine.poses.stored_search import STORED_DATABASE
from octasplat.workers.storage.trees import TreeFile

_PLAN_FILES = ("run/blocks/plan.npz", "run/blocks/coarse/best.npz")


@dataclass(frozen=True)
class Checkpoint:
    """Checkpoint from which a later attempt resumes, as the job's row stores it.

    Attributes:
        attempt: that made it.
        stage: of the work.
        step: of the stage.
        files: what is needed.
        results: what the same settings gave in the version that made it, see
            :data:`octasplat.engine.core.versions.RESULTS_VERSION`; versions that did not say so gave the
            first.
    """

    attempt: int
    stage: str
    step: int
    files: tuple[TreeFile, ...]
    results: int = field(default_factory=lambda: versions.RESULTS_VERSION)

    def as_row(self) -> dict[str, Any]:
        """Return the checkpoint as JSON values."""
        return {
            "attempt": self.attempt,
            "stage": self.stage,
            "step": self.step,
            "files": [file.model_dump() for file in self.files],
            "results": self.results,
        }

    @classmethod
    def from_row(cls, row: Mapping[str, Any]) -> "Checkpoint":
        """Return the checkpoint of JSON values."""
        files = tuple(TreeFile.model_validate(file) for file in row["files"])
        return cls(row["attempt"], row["stage"], row["step"], files, row.get("results", 1))

    @property
    def is_of_pose_search(self) -> bool:
        """Return whether it is the state of a search for poses."""
        return any(file.path.endswith(f"/{STORED_DATABASE}") for file in self.files)

    @property
    def size_bytes(self) -> int:
        """Return the size of its files together."""
        return sum(file.size_bytes for file in self.files)

    def is_after(self, other: "Checkpoint | None") -> bool:
        """Return whether the work is further than at ``other``."""
        stages = ("features", "matches", "poses", "load", "train", "residual", "evaluate", "export")
        order = {stage: place - stages.index("poses") for place, stage in enumerate(stages)}
        if other is None:
            return True
        return (order.get(self.stage, 0), self.step) > (order.get(other.stage, 0), other.step)


def plan_digest(checkpoint: Checkpoint) -> str:
    """Return what tells the plan of blocks in a checkpoint, with the coarse scene, from any other."""
    files = {file.path: file.sha256 for file in checkpoint.files}
    return "-".join(files.get(name, "") for name in _PLAN_FILES)
