"""Check of the meshes of a stage that are to be glass, in a child process with limits."""

import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from octasplat.engine.pathtracing.stage.model import StageMesh
from octasplat.engine.pathtracing.stage.sidecar_files import IMAGE_SUFFIXES, MTL_SUFFIX
from octasplat.service.intake.mesh_child import MeshAnswer, MeshRequest
from octasplat.service.intake.parser_process import ParserError, run_parser
from octasplat.workers.storage.protocol import Storage
from octasplat.workers.storage.trees import TreeFile, fetch_tree

CHILD = "octasplat.service.intake.mesh_child"


@dataclass(frozen=True)
class MeshLimits:
    """What the check of a stage's meshes may take; beyond it, the job checks them.

    Attributes:
        max_bytes: length of the files that are read, together; from a bucket they come over the network.
        memory_bytes: address space of the child; some 0.5 GB of it are the libraries.
        cpu_seconds: processor time; 64 MB of OBJ take some 10 s.
        seconds: time by the clock.
        hidden: folders that the child cannot open.
    """

    max_bytes: int = 64 << 20
    memory_bytes: int = 4 << 30
    cpu_seconds: int = 20
    seconds: float = 30.0
    hidden: tuple[Path, ...] = ()


def find_open_glass(
    storage: Storage, meshes: Mapping[int, StageMesh], files: Sequence[TreeFile], limits: MeshLimits
) -> Mapping[int, str]:
    """Return a sentence on each mesh that cannot be glass, by its number; none where the job is to tell.

    Args:
        storage: holds the files.
        meshes: those of the stage that are to be glass, by their numbers.
        files: all that were sent for the stage, named as in it.
        limits: what reading may take.

    Raises:
        StorageError: the files cannot be had.
    """
    read, named = _files_to_read(meshes, files)
    if sum(file.size_bytes for file in read) > limits.max_bytes:
        return {}
    with tempfile.TemporaryDirectory(prefix="octasplat-meshes-") as folder:
        root = Path(folder)
        fetch_tree(storage, read, root, writable=True)  # copies, as the child is not trusted
        for file in named:
            (root / file.path).parent.mkdir(parents=True, exist_ok=True)
            (root / file.path).touch()
        request = MeshRequest(
            root=root,
            meshes=dict(meshes),
            memory_bytes=limits.memory_bytes,
            cpu_seconds=limits.cpu_seconds,
            hidden=limits.hidden,
        )
        try:
            return run_parser(CHILD, request, MeshAnswer, limits.seconds).faults
        except ParserError:
            return {}


def _files_to_read(
    meshes: Mapping[int, StageMesh], files: Iterable[TreeFile]
) -> tuple[list[TreeFile], list[TreeFile]]:
    """Return the files whose content is read, and those that only have to be there: images of an OBJ."""
    names = {mesh.file for mesh in meshes.values()}
    with_mtl = any(str(name).lower().endswith(".obj") for name in names)
    read, named = list[TreeFile](), list[TreeFile]()
    for file in files:
        suffix = PurePosixPath(file.path).suffix.lower()
        if file.path in names or (with_mtl and suffix == MTL_SUFFIX):
            read.append(file)
        elif with_mtl and suffix in IMAGE_SUFFIXES:
            named.append(file)
    return read, named
