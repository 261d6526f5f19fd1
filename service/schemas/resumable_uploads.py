"""Bodies of the routes on uploads of one large file each."""

import uuid
from datetime import datetime

from pydantic import BaseModel, ConfigDict, Field

from octasplat.service.intake import receive
from octasplat.service.schemas.base import EXAMPLE_ID, EXAMPLE_TIME
from octasplat.workers.db.uploads import FileUpload


class UploadView(BaseModel):
    """An upload of one file that goes on after a break."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": EXAMPLE_ID,
                    "dataset_id": EXAMPLE_ID,
                    "path": "sparse/0/points3D.bin",
                    "size_bytes": 402000008,
                    "offset_bytes": 67108864,
                    "part_bytes": 8388608,
                    "parts_ahead": [100663296],
                    "task_id": None,
                    "created_at": EXAMPLE_TIME,
                    "expires_at": EXAMPLE_TIME,
                }
            ]
        }
    )

    id: uuid.UUID
    dataset_id: uuid.UUID
    path: str | None = Field(description="Name of the file in the dataset; null for a ZIP file.")
    size_bytes: int
    offset_bytes: int = Field(description="How much has come; go on behind it.")
    part_bytes: int = Field(
        description="Length of the parts, but for the last one, that `PUT .../parts/{start_bytes}` takes."
    )
    parts_ahead: list[int] = Field(
        description="Where such parts begin that have come, though not all before them has."
    )
    task_id: uuid.UUID | None = Field(description="Task that stores the file, once all of it has come.")
    created_at: datetime
    expires_at: datetime = Field(description="When it is given up unless more comes.")

    @classmethod
    def from_row(cls, row: FileUpload, parts_ahead: list[int]) -> "UploadView":
        """Return the view of a database row, and of where parts begin that came out of order."""
        return cls(
            id=row.id,
            dataset_id=row.dataset_id,
            path=row.path,
            size_bytes=row.size_bytes,
            offset_bytes=row.offset_bytes,
            part_bytes=receive.PARALLEL_PART_BYTES,
            parts_ahead=parts_ahead,
            task_id=row.task_id,
            created_at=row.created_at,
            expires_at=row.expires_at,
        )
