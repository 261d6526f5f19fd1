"""Bodies of the routes on datasets and their files."""

import uuid
from datetime import datetime
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, field_validator

from octasplat.service.schemas.base import EXAMPLE_ID, EXAMPLE_TIME, RequestBody
from octasplat.workers.db.rows import Dataset, DatasetFile, DatasetHolds, DatasetState

MAX_IMPORT_URL = 10_000
"""Characters; signed addresses of a bucket hold the whole of a temporary credential, up to 4 kB."""
MAX_REUSED_FILES = 1000
"""Files that are asked for in one request."""


class NewDataset(RequestBody):
    """Dataset to create."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"name": "fox"}]})

    name: str = Field("", max_length=200, description="What you call it.")
    holds: DatasetHolds = Field(
        "photographs",
        description="`files` takes what the options of a job name, such as the meshes, textures and "
        "surroundings of a stage, under names of your own; jobs get them by `files_id`.",
    )


class NewImport(RequestBody):
    """Files that the service fetches from an address."""

    model_config = ConfigDict(
        extra="forbid", json_schema_extra={"examples": [{"url": "https://example.org/fox.zip"}]}
    )

    url: str = Field(
        min_length=1,
        max_length=MAX_IMPORT_URL,
        description="https, port 443 or 8443, reachable from everywhere; so must redirects be.",
    )
    path: str | None = Field(
        None,
        min_length=1,
        max_length=1000,
        description="Name of the one file that it is, such as images/0001.jpg; by default it is a ZIP file.",
    )
    sha256: str | None = Field(None, pattern="^[0-9a-f]{64}$", description="What it must be, in hexadecimal.")


class DatasetChange(RequestBody):
    """Changes of a dataset."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"pinned": True}]})

    name: str | None = Field(None, max_length=200, description="What to call it.")
    pinned: bool | None = Field(None, description="Keep it whatever its age.")


class DatasetView(BaseModel):
    """A dataset."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": EXAMPLE_ID,
                    "name": "fox",
                    "holds": "photographs",
                    "state": "committed",
                    "has_poses": True,
                    "photographs": 50,
                    "facts": {"points": 8712, "camera_models": ["OPENCV"]},
                    "pinned": False,
                    "created_at": EXAMPLE_TIME,
                    "committed_at": EXAMPLE_TIME,
                    "expires_at": None,
                }
            ]
        }
    )

    id: uuid.UUID
    name: str
    holds: DatasetHolds
    state: DatasetState = Field(
        description="`open` takes files, `checking` waits for its commit, `committed` never changes again."
    )
    has_poses: bool = Field(description="Whether it holds poses; if not, a reconstruction finds them.")
    photographs: int
    facts: dict[str, Any] = Field(description="What the check at commit found out.")
    pinned: bool
    created_at: datetime
    committed_at: datetime | None
    expires_at: datetime | None

    @classmethod
    def from_row(cls, row: Dataset) -> "DatasetView":
        """Return the view of a database row."""
        return cls.model_validate(row, from_attributes=True)


class DatasetPage(BaseModel):
    """A page of the list of datasets."""

    datasets: list[DatasetView]
    next: str | None = Field(description="Cursor of the next part.")


class FileView(BaseModel):
    """An uploaded file."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "path": "images/0001.jpg",
                    "sha256": "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855",
                    "size_bytes": 123456,
                    "facts": {"kind": "JPEG", "width_px": 1920, "height_px": 1080},
                    "uploaded_at": EXAMPLE_TIME,
                }
            ]
        }
    )

    path: str
    sha256: str
    size_bytes: int
    facts: dict[str, Any]
    uploaded_at: datetime

    @classmethod
    def from_row(cls, row: DatasetFile) -> "FileView":
        """Return the view of a database row."""
        return cls.model_validate(row, from_attributes=True)


class FileDigest(RequestBody):
    """A file that you have, by its digest."""

    path: str = Field(min_length=1, max_length=1000, description="Its name in the dataset.")
    sha256: str = Field(pattern="^[0-9a-f]{64}$", description="Digest of its content, in hexadecimal.")


class FilesToReuse(RequestBody):
    """Files that are taken without being sent, where their contents are stored for the owner already."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {
                    "files": [
                        {
                            "path": "images/0001.jpg",
                            "sha256": "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855",
                        }
                    ]
                }
            ]
        },
    )

    files: list[FileDigest] = Field(
        max_length=MAX_REUSED_FILES, description="What you have; each path once, 1,000 in one request."
    )

    @field_validator("files")
    @classmethod
    def _check_paths_differ(cls, files: list[FileDigest]) -> list[FileDigest]:
        if len({file.path for file in files}) < len(files):
            raise ValueError("Two of the files have the same path.")
        return files


class ReusedFilesView(BaseModel):
    """Which of the files are in the dataset now, and which have to be sent."""

    files: list[FileView] = Field(description="Taken from what the owner has stored.")
    missing: list[str] = Field(description="Paths of the others; send these.")


class FilePage(BaseModel):
    """A page of the list of files; a resumed upload compares it with the local files."""

    files: list[FileView]
    next: str | None


class ArchiveView(BaseModel):
    """Result of unpacking an archive into a dataset."""

    files: list[FileView]
    left_out: list[str] = Field(description="Files that are no part of a scene.")
    notes: list[str] = Field(description="Sentences on what is left out, with the way out.")
