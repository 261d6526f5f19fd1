"""What would be taken of a scene, before it is sent."""

from pydantic import BaseModel, ConfigDict, Field

from octasplat.service.intake.scene_preview import ScenePreview
from octasplat.service.schemas.base import RequestBody

MAX_LISTED_FILES = 100_000


class ListedFile(BaseModel):
    """A file of a folder."""

    model_config = ConfigDict(extra="forbid")

    path: str = Field(min_length=1, max_length=4096, description="Below the folder, with forward slashes.")
    size_bytes: int = Field(ge=0, le=1 << 50)


class NewScenePreview(RequestBody):
    """The files of a folder that is to be sent."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"files": [{"path": "images/0001.jpg", "size_bytes": 123456}]}]},
    )

    files: list[ListedFile] = Field(
        max_length=MAX_LISTED_FILES, description="`path` and `size_bytes` of each file below the folder."
    )


class PreviewedFileView(BaseModel):
    """A file that is taken."""

    name: str = Field(description="What it is called in the dataset; send it under this name.")
    path: str = Field(description="Where it is in the folder or archive.")
    size_bytes: int


class RefusalView(BaseModel):
    """A reason for which the whole would be refused."""

    code: str
    detail: str
    file: str | None = None


class ScenePreviewView(BaseModel):
    """The files that would be taken of a folder or an archive."""

    files: list[PreviewedFileView]
    left_out: list[str] = Field(description="Files that are no part of a scene.")
    notes: list[str] = Field(description="Sentences on what is left out, with the way out.")
    refusals: list[RefusalView] = Field(description="Why the whole would be refused; empty if it would not.")
    folder: str = Field(description="The folder around everything, with its slash.")
    photographs: int
    has_poses: bool = Field(description="Whether there is a COLMAP model; if not, poses are found.")
    needed_bytes: int | None = Field(
        description="So much of the end of the archive is needed to tell; send it. Null where it was enough."
    )

    @classmethod
    def from_preview(cls, preview: ScenePreview, needed_bytes: int | None = None) -> "ScenePreviewView":
        """From what the intake says."""
        return cls(
            files=[PreviewedFileView.model_validate(file, from_attributes=True) for file in preview.files],
            left_out=list(preview.left_out),
            notes=list(preview.notes),
            refusals=[RefusalView.model_validate(fault, from_attributes=True) for fault in preview.faults],
            folder=preview.folder,
            photographs=preview.photographs,
            has_poses=preview.has_poses,
            needed_bytes=needed_bytes,
        )
