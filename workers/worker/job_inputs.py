"""What a job works on: its photographs, files that it names, and results of other jobs."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from octasplat.workers.db.connections import Connection
from octasplat.workers.db.datasets import files_of, get_dataset
from octasplat.workers.db.rows import Artifact, Dataset, DatasetFile, Job
from octasplat.workers.queue.block_results import files_from_others
from octasplat.workers.queue.jobs import artifacts_of, get_job
from octasplat.workers.storage.trees import TreeFile
from octasplat.workers.worker.checkpoint import Checkpoint, plan_digest
from octasplat.workers.worker.job_kinds import JobKind
from octasplat.workers.worker.start_files import start_choices
from octasplat.workers.worker.task import RUN_FOLDER
from octasplat.workers.worker.workspace import Workspace


@dataclass(frozen=True)
class JobInputs:
    """Rows of what a job works on.

    Attributes:
        dataset: the photographs, if it has some.
        photographs: the files of the dataset.
        artifacts: results of the source job.
        starts: what it may begin with, if it begins with the source job; see
            :func:`octasplat.workers.worker.start_files.start_choices`.
        others: what other jobs have made for it.
        named: files that its options name.
    """

    dataset: Dataset | None
    photographs: Sequence[DatasetFile]
    artifacts: Sequence[Artifact]
    starts: Sequence[Sequence[TreeFile]]
    others: Sequence[TreeFile]
    named: Sequence[DatasetFile]

    def copied_bytes(self, kind: JobKind) -> int:
        """Return the bytes of what is copied into the folder of an attempt, without its checkpoint."""
        copied = sum(row.size_bytes for row in self.artifacts if row.name in kind.source_files)
        copied += max((sum(file.size_bytes for file in files) for files in self.starts), default=0)
        return copied + sum(file.size_bytes for file in self.others)


async def read_inputs(connection: Connection, job: Job, kind: JobKind, options: BaseModel) -> JobInputs:
    """Return what a job with these complete options works on."""
    source = await get_job(connection, job.source_id) if job.source_id else None
    artifacts = await artifacts_of(connection, job.source_id) if job.source_id else []
    begins = source is not None and kind.starts_from_result(options)
    return JobInputs(
        dataset=await get_dataset(connection, job.dataset_id) if job.dataset_id else None,
        photographs=await files_of(connection, job.dataset_id) if job.dataset_id else [],
        artifacts=artifacts,
        starts=start_choices(source, artifacts) if begins and source is not None else [],
        others=await files_from_others(connection, job, plan=_plan_of(job)) if job.role is not None else [],
        named=await files_of(connection, job.files_id) if job.files_id else [],
    )


def _plan_of(job: Job) -> str:
    """Return the digest of the plan of blocks that a job goes on with."""
    return "" if job.checkpoint is None else plan_digest(Checkpoint.from_row(job.checkpoint))


def fetch_photographs(
    workspace: Workspace, kind: JobKind[Any], options: BaseModel, inputs: JobInputs
) -> Path:
    """Fetch the photographs that a job needs, after all else that goes into its folder; blocks.

    Returns:
        The folder of the photographs, in which others may be empty.

    Raises:
        StorageError: a photograph is gone or damaged, or the folder cannot be written.
        CheckpointError: what tells which are needed is damaged.
    """
    dataset, files = inputs.dataset, inputs.photographs
    assert dataset is not None
    needed = kind.needed_files(options, workspace.folder / RUN_FOLDER, [file.path for file in files])
    return workspace.fetch_dataset(dataset.id, files, dataset.name, needed)
