"""Time and memory of edits and deformations of a random scene.

    python benchmarks/edit_scale.py [COUNT] [SH_DEGREE] [ROWS THAT HOLD THIS WORD]

Each command runs as a user would run it, in a process of its own; its peak of resident memory counts pages of
files that it has mapped, too. Meshes: the exported PLY as it is; twisted; likewise with vertices in another
order; OBJ and GLB. Proxies: a sheet of 24 x 24 cells through the scene, and a cage of 4 x 4 cells a side.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from octasplat.engine.core.ply_container import read_ply
from octasplat.engine.files import export_scene
from octasplat.engine.gaussians.model import FlatGaussians
from tests.support.edit_scenes import cube, grid


def random_scene(count: int, degree: int) -> FlatGaussians:
    """Small Gaussians in a cube of 2 units, most of them opaque."""
    random = np.random.default_rng(0)

    def normal(*shape: int) -> np.ndarray:
        return random.standard_normal(shape, dtype=np.float32)

    means = random.uniform(-1, 1, (count, 3)).astype(np.float32)
    size = np.float32(np.log(2 * count ** (-1 / 3) / 3))
    coefficients = (degree + 1) ** 2
    return FlatGaussians(
        means,
        normal(count, 4),
        0.3 * normal(count, 2) + size,
        normal(count) + 2,
        0.2 * normal(count, coefficients, 3),
    )


def twisted(points: np.ndarray) -> np.ndarray:
    """One radian a unit about z."""
    x, y, z = points.T
    return np.stack([np.cos(z) * x - np.sin(z) * y, np.sin(z) * x + np.cos(z) * y, z], axis=-1)


def write_edited(source: Path, target: Path, *, shuffle: bool) -> None:
    """A copy of a mesh PLY with its vertices twisted, and in another order if asked."""
    header, tables = read_ply(source, ["vertex", "face"])
    vertex, face = tables["vertex"], tables["face"]
    moved = twisted(np.stack([vertex[name] for name in "xyz"], axis=-1).astype(np.float64))
    for axis, name in enumerate("xyz"):
        vertex[name] = moved[:, axis]
    if shuffle:
        order = np.random.default_rng(1).permutation(len(vertex))
        place = np.empty(len(order), np.int32)
        place[order] = np.arange(len(order))
        vertex = vertex[order]
        face["vertex_indices"] = place[face["vertex_indices"]]
    with target.open("wb") as handle, source.open("rb") as original:
        handle.write(original.read(header.data_offset))
        handle.write(vertex.tobytes())
        handle.write(face.tobytes())


def write_obj(path: Path, vertices: np.ndarray, triangles: np.ndarray) -> None:
    """A plain OBJ."""
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in triangles + 1]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def measure(name: str, *arguments: object) -> None:
    """One row of the table, if it was asked for."""
    if len(sys.argv) > 3 and sys.argv[3] not in name:
        return
    command = [sys.executable, "-m", "octasplat", *(str(argument) for argument in arguments), "--quiet"]
    began = time.perf_counter()
    process = subprocess.Popen(command)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise SystemExit(f"{name} ended with exit code {process.returncode}")
    seconds = time.perf_counter() - began
    worked = usage.ru_utime + usage.ru_stime
    print(f"| {name} | {seconds:.0f} | {worked:.0f} | {usage.ru_maxrss * 1024 / 1e6:,.0f} |", flush=True)


def main() -> None:
    """Print the table."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    degree = int(sys.argv[2]) if len(sys.argv) > 2 else 0
    scene = random_scene(count, degree)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        meshes = [folder / "mesh.ply", folder / "mesh.obj", folder / "mesh.glb"]
        export_scene(scene, folder / "scene.ply")
        for path in meshes:
            export_scene(scene, path)
        write_edited(meshes[0], folder / "twisted.ply", shuffle=False)
        write_edited(meshes[0], folder / "shuffled.ply", shuffle=True)
        proxies = {"sheet": grid(24, 1.0), "cage": cube(4, 1.05)}
        for kind, (vertices, triangles) in proxies.items():
            write_obj(folder / f"{kind}.obj", vertices, triangles)
            write_obj(folder / f"{kind}_twisted.obj", twisted(vertices), triangles)
        print(f"{count:,} Gaussians of degree {degree}\n")
        print("| command | s | s of CPU | peak memory, MB |\n|---|---|---|---|", flush=True)
        source, output = folder / "scene.ply", folder / "out.ply"
        edited = [meshes[0], folder / "twisted.ply", folder / "shuffled.ply", meshes[1], meshes[2]]
        names = ["as it was", "twisted", "twisted, vertices in another order", "OBJ", "GLB"]
        for text, mesh in zip(names, edited, strict=True):
            measure(f"edit, {text}", "edit", source, "--mesh", mesh, "-o", output)
        for kind, options in (("sheet", ["--reach", "inf"]), ("cage", ["--method", "mvc"])):
            rest, moved = folder / f"{kind}.obj", folder / f"{kind}_twisted.obj"
            files = ("--proxy", rest, "--deformed", moved, "-o", output)
            measure(f"deform, {kind}", "deform", source, *files, *options)


if __name__ == "__main__":
    main()
