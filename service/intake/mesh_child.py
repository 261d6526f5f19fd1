"""Child process that reads the meshes of a stage that are to be glass, and tells which of them cannot be.

    python -P -m octasplat.service.intake.mesh_child < request.json > answer.json

It gives up rights as :mod:`octasplat.service.intake.parser_child` says. Only ``check`` imports the readers of
meshes. The parent is :mod:`octasplat.service.intake.mesh_check`; the request and the answer are defined here.
"""

from pydantic import BaseModel

from octasplat.engine.core.errors import ConfigError, SceneFileError
from octasplat.engine.pathtracing.stage.model import StageMesh
from octasplat.service.intake.parser_child import ParserRequest, answer_request


class MeshRequest(ParserRequest):
    """Request to the child process that reads meshes; ``root`` holds their files.

    Attributes:
        meshes: by their numbers in the stage.
    """

    meshes: dict[int, StageMesh]


class MeshAnswer(BaseModel):
    """Response of the child process: a sentence on each mesh that cannot be glass, by its number."""

    faults: dict[int, str] = {}


def main() -> None:
    """Read the request from stdin, read the meshes, and write the answer to stdout."""
    answer_request(MeshRequest, check)


def check(request: MeshRequest) -> MeshAnswer:
    """Read the meshes, and list those that are not closed or cannot be read."""
    from octasplat.engine.pathtracing.mesh_files import check_glass_is_closed

    faults: dict[int, str] = {}
    for number, mesh in request.meshes.items():
        try:
            check_glass_is_closed({number: mesh}, request.root)
        except (ConfigError, SceneFileError) as error:
            faults[number] = request.without_root(str(error))
        except MemoryError:
            continue  # the job, which may take more, reads it
    return MeshAnswer(faults=faults)


if __name__ == "__main__":
    main()
