"""Bodies of the routes on job results."""

from pydantic import BaseModel, ConfigDict

from octasplat.workers.db.rows import Artifact


class ArtifactView(BaseModel):
    """A result of a job."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "name": "viewer.glb",
                    "sha256": "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855",
                    "size_bytes": 7340032,
                    "media_type": "model/gltf-binary",
                }
            ]
        }
    )

    name: str
    sha256: str
    size_bytes: int
    media_type: str

    @classmethod
    def from_row(cls, row: Artifact) -> "ArtifactView":
        """Return the view of a database row."""
        return cls.model_validate(row, from_attributes=True)


class ArtifactList(BaseModel):
    """The results of a job."""

    artifacts: list[ArtifactView]
