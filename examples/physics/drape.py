"""Let the top of a table, with all that stands on it, become a cloth that drapes itself over what is below.

    python drape.py SCENE.ply -o drape.mp4

The cloth is a coarse round grid that MuJoCo moves; the Gaussians follow it as with octasplat deform.
"""

import argparse
from pathlib import Path

import numpy as np
from drop import add_film_options, triple, write_film
from jaxtyping import Bool, Float64, Int64
from mujoco_drop import simulate_cloth

from octasplat.engine.edit.deform import deform_to, deformation_corners
from octasplat.engine.edit.proxy import Proxy, bind_corners
from octasplat.engine.files import read_scene
from octasplat.engine.gaussians.model import FlatGaussians


def round_grid(
    centre_world: Float64[np.ndarray, "3"], radius: float, cells: int
) -> tuple[Float64[np.ndarray, "v 3"], Int64[np.ndarray, "t 3"]]:
    """Vertices (world) and triangles of a horizontal disc, cut from a square of ``cells`` x ``cells``."""
    u, v = np.meshgrid(np.linspace(-1, 1, cells + 1), np.linspace(-1, 1, cells + 1), indexing="ij")
    flat = np.stack([u.ravel(), v.ravel(), np.zeros(u.size)], axis=1)
    number = np.arange(u.size).reshape(u.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    halves = [np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))]
    triangles = np.concatenate(halves)
    inside = np.linalg.norm(flat[triangles].mean(axis=1), axis=1) <= 1.0
    used, triangles = np.unique(triangles[inside], return_inverse=True)
    return centre_world + radius * flat[used], triangles.reshape(-1, 3)


def stands_on(
    gaussians: FlatGaussians,
    centre_world: Float64[np.ndarray, "3"],
    radius: float,
    below: float,
    above: float,
) -> Bool[np.ndarray, " n"]:
    """Gaussians with their centre in an upright cylinder around the disc."""
    offsets = gaussians.means_world.astype(np.float64) - centre_world
    upright = (offsets[:, 2] >= -below) & (offsets[:, 2] <= above)
    result: np.ndarray = upright & (np.linalg.norm(offsets[:, :2], axis=1) <= radius)
    return result


class ClothRider:
    """Gaussians that follow a grid of triangles."""

    def __init__(
        self,
        gaussians: FlatGaussians,
        vertices_world: Float64[np.ndarray, "v 3"],
        triangles: Int64[np.ndarray, "t 3"],
    ) -> None:
        self._gaussians = gaussians
        self._corners = deformation_corners(gaussians)
        self._binding = bind_corners(Proxy(vertices_world, triangles), self._corners, reach_world=np.inf)

    def at(self, nodes_world: Float64[np.ndarray, "v 3"]) -> FlatGaussians:
        """The Gaussians when the grid's vertices are there."""
        return deform_to(self._gaussians, self._corners, self._binding.deform(nodes_world))[0]


def main() -> None:
    """Run the example."""
    options = _options()
    scene, _ = read_scene(options.scene)
    centre = np.array(options.at)
    mine = stands_on(scene, centre, options.radius, options.below, options.above)
    vertices, triangles = round_grid(centre, options.radius, options.cells)
    print(f"{mine.sum():,} Gaussians follow a cloth of {len(vertices):,} vertices.")
    frames = simulate_cloth(
        vertices, triangles, options.world, seconds=options.seconds, fps=options.fps, young=options.young
    )
    print(f"Simulated {len(frames)} frames.")
    write_film(options, scene.select(~mine), ClothRider(scene.select(mine), vertices, triangles), frames)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="a file of Gaussians, or the folder of a run")
    parser.add_argument("--at", type=triple, default=(0.0, 0.0, 0.0), help="middle of the table's top")
    parser.add_argument("--radius", type=float, default=1.03, help="of the table")
    parser.add_argument("--below", type=float, default=0.08, help="its thickness")
    parser.add_argument("--above", type=float, default=0.75, help="height of what stands on it")
    parser.add_argument("--cells", type=int, default=36, help="cells of the cloth from side to side")
    parser.add_argument("--young", type=float, default=3e6, help="stiffness")
    add_film_options(parser, world="pedestal.xml", seconds=1.5)
    parser.set_defaults(eye=(0.2, -3.1, 1.25), target=(0.0, 0.0, -0.05))
    return parser.parse_args()


if __name__ == "__main__":
    main()
