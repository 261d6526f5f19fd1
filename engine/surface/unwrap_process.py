"""The process in which xatlas unwraps a mesh; see :func:`unwrap_in_process`, which starts it.

Destroying an atlas can wait for ever: a thread of xatlas that is about to sleep misses the call to end. The
process exits without destroying its atlas. Arrays go through stdin and stdout in NumPy's format.
"""

import io
import os
import signal
import subprocess
import sys
from typing import IO, NamedTuple, NoReturn

import numpy as np
from jaxtyping import Float32, Integer, UInt32

from octasplat.engine.core.errors import ExportError
from octasplat.engine.core.isolated_python import python_command


class Atlas(NamedTuple):
    """A mesh cut along seams and laid out in a rectangle.

    Attributes:
        origin: vertex of the mesh that each vertex of the atlas was.
        faces: triangles of the vertices of the atlas.
        uv: coordinates of its vertices, from 0 to 1 along each side of the rectangle.
        size_px: width and height of the rectangle.
    """

    origin: Integer[np.ndarray, " v"]
    faces: Integer[np.ndarray, "f 3"]
    uv: Float32[np.ndarray, "v 2"]
    size_px: Integer[np.ndarray, " 2"]


def unwrap_in_process(
    vertices_world: Float32[np.ndarray, "n 3"],
    faces: UInt32[np.ndarray, "f 3"],
    normals_world: Float32[np.ndarray, "n 3"],
    *,
    resolution_px: int,
    padding_px: int,
) -> Atlas:
    """Unwrap a mesh by xatlas in a process of its own.

    Args:
        vertices_world: its vertices.
        faces: its triangles.
        normals_world: unit normals at the vertices.
        resolution_px: side of the square that the charts are to fill about.
        padding_px: between charts.

    Raises:
        ExportError: the process ended without a result.
    """
    packed = io.BytesIO()
    for array in (vertices_world, faces, normals_world, np.array([resolution_px, padding_px])):
        np.save(packed, array)
    done = subprocess.run(  # noqa: S603 - a program of ours
        python_command("octasplat.engine.surface.unwrap_process", further_modules=("xatlas",)),
        input=packed.getvalue(),
        capture_output=True,
        check=False,
    )
    if done.returncode != 0:
        last = done.stderr.decode("utf-8", "replace").strip().splitlines()[-1:]
        raise ExportError(
            f"xatlas could not unwrap {len(faces)} triangles (exit code {done.returncode}"
            f"{''.join(f', {line}' for line in last)}); choose fewer triangles, or colors at the vertices."
        )
    result = io.BytesIO(done.stdout)
    return Atlas(*(np.load(result) for _ in Atlas._fields))  # arrays in the order of the fields


def _unwrap(source: IO[bytes], result: IO[bytes]) -> NoReturn:
    import xatlas

    vertices_world, faces, normals_world, (resolution_px, padding_px) = (np.load(source) for _ in range(4))
    atlas = xatlas.Atlas()
    atlas.add_mesh(vertices_world, faces, normals_world)
    charts, packing = xatlas.ChartOptions(), xatlas.PackOptions()
    packing.resolution, packing.padding, packing.bilinear = int(resolution_px), int(padding_px), True
    atlas.generate(charts, packing)
    packed = io.BytesIO()  # NumPy asks a file for its position, which a pipe has not
    for array in (*atlas[0], np.array([atlas.width, atlas.height])):
        np.save(packed, array)
    result.write(packed.getvalue())
    result.flush()
    os._exit(0)  # destroys no atlas


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that waits
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever libraries print goes to stderr
    _unwrap(io.BytesIO(sys.stdin.buffer.read()), out)
