"""Bodies of the routes on uploads of one large file each."""

import uuid
from datetime import datetime

from pydantic import BaseModel, ConfigDict, Field

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
    task_id: uuid.UUID | None = Field(description="Task that stores the file, once all of it has come.")
    created_at: datetime
    expires_at: datetime = Field(description="When it is given up unless more comes.")

    @classmethod
    def from_row(cls, row: FileUpload) -> "UploadView":
        """Return the view of a database row."""
        return cls.model_validate(row, from_attributes=True)
