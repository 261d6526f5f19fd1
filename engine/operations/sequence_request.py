"""Base of requests that make a scene, or a sequence of scenes, from meshes."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from octasplat.engine.operations.base import CHANGED_SCENE, SourceRequest
from octasplat.engine.settings.fields import OUTPUT_FLAGS, Spelling


class SequenceRequest(SourceRequest):
    """Base of requests that read a scene and write one for each mesh."""

    output: Annotated[Path, OUTPUT_FLAGS] = Field(
        description=f"{CHANGED_SCENE} For a sequence a pattern such as out/%04d.ply, or a folder."
    )
    report: Annotated[Path | None, Spelling(metavar="FILE.json")] = Field(
        None, description="Write all counts there."
    )
