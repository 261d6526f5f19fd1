"""Let a copy of one thing of a reconstruction fall as a soft body, and film it.

    python drop.py SCENE.ply THING.ply -o drop.mp4

THING.ply is a closed mesh of the thing, as octasplat surface makes it; see the README beside this file.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

import numpy as np
from mujoco_drop import simulate
from soft_body import Rider, belongs_to, lattice_around

from octasplat.engine.files import read_mesh, read_scene
from octasplat.engine.gaussians.model import FlatGaussians, concatenate
from octasplat.engine.geometry.triangle_mesh import TriangleMesh
from octasplat.engine.render.image_files import write_png
from octasplat.engine.render.pinhole_camera import PinholeCamera, focal_from_fov
from octasplat.engine.render.pose_paths import look_at
from octasplat.engine.render.renderer import render_rays
from octasplat.engine.render.video import VideoWriter
from octasplat.engine.trace.cpu.tracer import CpuTracer
from octasplat.engine.trace.protocol import Tracer


class Rides(Protocol):
    """Gaussians that follow simulated nodes."""

    def at(self, nodes_world: np.ndarray) -> FlatGaussians:
        """The Gaussians when the nodes are there."""
        ...


def film(
    still: FlatGaussians,
    rider: Rides,
    frames: np.ndarray,
    camera: PinholeCamera,
    tracer: Tracer,
) -> Iterator[np.ndarray]:
    """Images of the scene with the moved thing in it, display values (h, w, 3)."""
    rays = camera.rays()
    for nodes in frames:
        tracer.build(concatenate([still, rider.at(nodes)]))
        yield render_rays(tracer, rays, np.zeros(3, np.float32)).rgb_srgb


def write_film(options: argparse.Namespace, still: FlatGaussians, rider: Rides, frames: np.ndarray) -> None:
    """Write the video, and its frames as PNG if asked."""
    pose = look_at(np.array(options.eye), np.array(options.target), np.array([0.0, 0.0, 1.0]))
    focal = focal_from_fov(options.fov, options.height)
    camera = PinholeCamera.from_pose(pose, options.width, options.height, fy_px=focal)
    with VideoWriter(options.output, options.fps, options.width, options.height) as video:
        for number, image in enumerate(film(still, rider, frames, camera, CpuTracer())):
            video.write(image)
            if options.frames:
                write_png(options.frames / f"{number:04d}.png", image)
    print(f"Wrote {options.output}.")


def main() -> None:
    """Run the example."""
    options = _options()
    scene, _ = read_scene(options.scene)
    read = read_mesh(options.thing)
    mesh = TriangleMesh(read.vertices.astype(np.float32), read.triangles.astype(np.int32))
    mine = belongs_to(scene, mesh, options.near)
    lattice = lattice_around(mesh, options.cell)
    print(
        f"{mine.sum():,} Gaussians ride in {len(lattice.cells):,} cells, {len(lattice.nodes_world):,} nodes."
    )
    frames = simulate(
        lattice,
        options.world,
        move=options.move,
        seconds=options.seconds,
        fps=options.fps,
        young=options.young,
    )
    print(f"Simulated {len(frames)} frames.")
    rider = Rider(scene.select(mine), lattice)
    still = scene if options.keep else scene.select(~mine)
    write_film(options, still, rider, frames)


def add_film_options(parser: argparse.ArgumentParser, world: str, seconds: float) -> None:
    """What all films need: the world that things fall on, the camera, the files."""
    parser.add_argument("-o", "--output", type=Path, required=True, help="the video, .mp4")
    parser.add_argument("--frames", type=Path, help="also write the frames as PNG into this folder")
    parser.add_argument("--world", type=Path, default=Path(__file__).with_name(world), help="MJCF")
    parser.add_argument("--seconds", type=float, default=seconds)
    parser.add_argument("--fps", type=float, default=24)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=480)
    parser.add_argument("--fov", type=float, default=34.0, help="from top to bottom, degrees")
    parser.add_argument("--eye", type=triple, default=(0.1, -2.25, 1.05))
    parser.add_argument("--target", type=triple, default=(0.05, -0.4, 0.28))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="a file of Gaussians, or the folder of a run")
    parser.add_argument("thing", type=Path, help="a closed mesh of the thing")
    parser.add_argument("--move", type=triple, default=(-0.38, -0.92, 0.75), help="shift before it falls")
    parser.add_argument("--cell", type=float, default=0.04, help="side of the lattice's cells")
    parser.add_argument(
        "--near", type=float, default=0.012, help="Gaussians so near to the mesh belong to it"
    )
    parser.add_argument("--young", type=float, default=4e4, help="stiffness")
    parser.add_argument("--take", dest="keep", action="store_false", help="the thing itself falls, no copy")
    add_film_options(parser, world="still_life.xml", seconds=2.5)
    return parser.parse_args()


def triple(text: str) -> tuple[float, float, float]:
    """Three numbers with commas between them."""
    x, y, z = (float(part) for part in text.split(","))
    return x, y, z


if __name__ == "__main__":
    main()
