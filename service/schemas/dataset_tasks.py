"""Bodies of the routes on tasks of datasets."""

import uuid
from datetime import datetime

from pydantic import BaseModel, ConfigDict, Field

from octasplat.service.problems import ProblemDocument
from octasplat.service.schemas.base import EXAMPLE_ID, EXAMPLE_TIME
from octasplat.workers.db.dataset_tasks import DatasetTask, TaskKind, TaskState


class TaskResult(BaseModel):
    """What an import or an upload brought."""

    files: int = Field(description="How many files came; `GET .../files` lists them.")
    left_out: list[str] = Field(description="Files that are no part of a scene, a thousand at most.")
    notes: list[str] = Field(description="Sentences on what is left out, with the way out.")


class TaskView(BaseModel):
    """A task on a dataset that lasts longer than a request."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": EXAMPLE_ID,
                    "dataset_id": EXAMPLE_ID,
                    "kind": "commit",
                    "state": "running",
                    "result": None,
                    "problem": None,
                    "created_at": EXAMPLE_TIME,
                    "started_at": EXAMPLE_TIME,
                    "finished_at": None,
                }
            ]
        }
    )

    id: uuid.UUID
    dataset_id: uuid.UUID
    kind: TaskKind
    state: TaskState = Field(
        description="`queued` waits for its turn, `succeeded` and `failed` never change again. A task goes "
        "on when the service is started again."
    )
    result: TaskResult | None = Field(description="Of an import or an upload that succeeded.")
    problem: ProblemDocument | None = Field(description="Why it failed.")
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None

    @classmethod
    def from_row(cls, row: DatasetTask) -> "TaskView":
        """Return the view of a database row."""
        return cls.model_validate(row, from_attributes=True)


class TaskPage(BaseModel):
    """A page of the list of tasks."""

    tasks: list[TaskView]
    next: str | None = Field(description="Cursor of the next part.")
