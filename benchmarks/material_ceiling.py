"""How near the path integrator comes to another program's pictures with nothing left to learn: the ceiling.

python benchmarks/material_ceiling.py SCENE            # SCENE/truth.json, its views in SCENE/test
python benchmarks/material_ceiling.py SCENE --views 3 --samples 128 --relit

True normals, depths, materials and the true environment go in. What camera rays meet is taken from the true
maps, interpolated between pixels of one surface; what all further rays meet are Gaussians with true
materials that are put on the true points of all views, octagon beside octagon. At outlines, where maps are
known at centres of pixels only, the share of a pixel that the scene covers is that of the true picture. With
``--gaussians`` camera rays meet the Gaussians too.
"""

import argparse
import time
from pathlib import Path

import numba
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.core.rays import ImageRays
from octasplat.engine.dataset import load_dataset_model
from octasplat.engine.evaluate.ground_truth import ViewGroundTruth, read_ground_truth
from octasplat.engine.evaluate.ground_truth_metrics import pooled_psnr
from octasplat.engine.gaussians.frames import quaternions_from_matrices
from octasplat.engine.gaussians.materials import MATERIAL_WIDTHS
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.pathtracing.compile_meshes import compile_meshes
from octasplat.engine.pathtracing.gaussian_layers import build_gaussian_layers
from octasplat.engine.pathtracing.kernels.path_args import SurfaceInteractions
from octasplat.engine.pathtracing.kernels.principled_bsdf import orthonormal_basis
from octasplat.engine.pathtracing.path_tracer import PathTracer, PathTracerScene
from octasplat.engine.pathtracing.stage.model import Environment, Integrator, Stage, StageGaussians
from octasplat.engine.render.image_files import read_image, write_png
from octasplat.engine.render.shots import view_shots
from octasplat.engine.trace.protocol import TraceSettings


@numba.njit
def axes_around(x, y, z):  # type: ignore[no-untyped-def]
    """Return two unit vectors across (x, y, z)."""
    return orthonormal_basis(x, y, z)


SPACING = 0.006
"""Distance of the Gaussians, of the scene's radius."""
OVERLAP = 0.62
"""Standard deviation of a Gaussian, of their distance."""
ONE_SURFACE = 0.02
"""Relative difference of depths up to which neighbouring pixels show one surface."""
LIFT = 0.25
"""Distance of secondary rays' beginnings from the true surface, of the distance of the Gaussians."""
PATHS = 1 << 18


class Buffer:
    """The true maps of a view, and points of its surfaces anywhere in its pixels."""

    def __init__(self, known: ViewGroundTruth, rays: ImageRays, axis_world: Float64[np.ndarray, "3"]) -> None:
        assert known.depth_z is not None and known.normal_world is not None
        assert known.albedo_linear is not None and known.metallic is not None and known.roughness is not None
        self.mask = known.mask
        self.rays = rays.directions_world.astype(np.float64)
        self.origin = rays.origin_world.astype(np.float64)
        self.axis = axis_world
        self.depth = known.depth_z.astype(np.float64)
        self.values = np.concatenate(
            [known.normal_world, known.albedo_linear, known.metallic[..., None], known.roughness[..., None]],
            axis=-1,
        ).astype(np.float64)

    def points(self) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 8"]]:
        """The points at the centres of all pixels of the mask, and their normals and materials."""
        along = self.rays[self.mask] / (self.rays[self.mask] @ self.axis)[:, None]
        return self.origin + self.depth[self.mask][:, None] * along, self.values[self.mask]

    def within(
        self, y: Int64[np.ndarray, " n"], x: Int64[np.ndarray, " n"], offsets: Float64[np.ndarray, "n 2"]
    ) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 8"], Float64[np.ndarray, "n 3"]]:
        """Points, values and unit directions in pixels of the mask, beside their centres by ``offsets``."""
        step = np.where(offsets >= 0, 1, -1)
        height, width = self.mask.shape
        rows, columns = np.clip(y + step[:, 0], 0, height - 1), np.clip(x + step[:, 1], 0, width - 1)
        part = np.abs(offsets)
        ways = self.rays / (self.rays @ self.axis)[..., None]
        way = sum((b * c)[:, None] * ways[at] for at, b, c in self._corners(y, x, rows, columns, part))
        total, values, inverse = np.zeros(len(y)), np.zeros((len(y), 8)), np.zeros(len(y))
        centre = self.depth[y, x]
        for at, b, c in self._corners(y, x, rows, columns, part):
            same = self.mask[at] & (np.abs(self.depth[at] - centre) < ONE_SURFACE * centre)
            weight = b * c * same
            total += weight
            values += weight[:, None] * self.values[at]
            inverse += weight / np.where(same, self.depth[at], 1.0)
        values /= total[:, None]
        values[:, :3] /= np.linalg.norm(values[:, :3], axis=1, keepdims=True)
        points = self.origin + (total / inverse)[:, None] * way
        return points, values, way / np.linalg.norm(way, axis=1, keepdims=True)

    @staticmethod
    def _corners(y, x, rows, columns, part):  # type: ignore[no-untyped-def]
        a, b = part[:, 0], part[:, 1]
        return (
            ((y, x), 1 - a, 1 - b),
            ((rows, x), a, 1 - b),
            ((y, columns), 1 - a, b),
            ((rows, columns), a, b),
        )


def gaussians_on(
    points: Float64[np.ndarray, "n 3"], values: Float64[np.ndarray, "n 8"], spacing: float
) -> FlatGaussians:
    """Opaque octagons on points, one a cell of a grid and a side that the surface faces."""
    side = np.argmax(np.abs(values[:, :3]), axis=1) * 2 + (
        np.take_along_axis(values[:, :3], np.argmax(np.abs(values[:, :3]), axis=1)[:, None], 1)[:, 0] > 0
    )
    cells = np.concatenate([np.floor(points / spacing).astype(np.int64), side[:, None]], axis=1)
    _, cell, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    both = np.concatenate([points, values], axis=1)
    sums = np.stack([np.bincount(cell, both[:, k], len(count)) for k in range(11)], axis=1)
    mean = sums / count[:, None]
    normals = mean[:, 3:6] / np.linalg.norm(mean[:, 3:6], axis=1, keepdims=True)
    frames = np.array([(n, *np.reshape(axes_around(*n), (2, 3))) for n in normals]).transpose(0, 2, 1)
    scene = FlatGaussians(
        mean[:, :3].astype(np.float32),
        quaternions_from_matrices(frames).astype(np.float32),
        np.full((len(mean), 2), np.log(OVERLAP * spacing), np.float32),
        np.full(len(mean), 7.0, np.float32),
        np.zeros((len(mean), 1, 3), np.float32),
    )
    ends = np.cumsum(list(MATERIAL_WIDTHS.values()))[:-1]
    materials = np.split(mean[:, 6:].astype(np.float32), ends, axis=1)
    return scene.with_channels(dict(zip(MATERIAL_WIDTHS, map(np.ascontiguousarray, materials), strict=True)))


def tracer_under(
    environment: Path,
    gaussians: FlatGaussians,
    up: Float64[np.ndarray, "3"],
    settings: Integrator,
    lift: float,
) -> PathTracer:
    """The integrator among the Gaussians, in the light of a map."""
    stage = Stage(
        up=tuple(up.tolist()),
        gaussians=(StageGaussians(light="relit", shadow_bias=lift),),
        environment=Environment(file=str(environment), visible=False),
        integrator=settings,
    )
    layers = build_gaussian_layers(
        stage, gaussians, lambda _path: gaussians, Path(), TraceSettings(), size=1.0
    )
    return PathTracer(PathTracerScene(compile_meshes(stage, Path()), layers), settings)


def picture_from(
    buffer: Buffer, covered: Float32[np.ndarray, "h w"], tracer: PathTracer, samples: int, lift: float
) -> Float64[np.ndarray, "h w 3"]:
    """Linear colors of all pixels that are covered; camera rays meet the true surfaces."""
    y, x = np.nonzero(covered > 0)
    at_y, at_x = nearest_in(buffer.mask, y, x)
    sums = np.zeros((len(y), 3))
    side = round(samples**0.5)
    for sample in range(side * side):
        cell = np.array(divmod(sample, side))
        offset = np.broadcast_to((cell + 0.5) / side - 0.5, (len(y), 2)).astype(np.float64)
        for first in range(0, len(y), PATHS):
            part = slice(first, first + PATHS)
            points, values, ways = buffer.within(at_y[part], at_x[part], offset[part])
            normals = values[:, :3]
            facing = (normals * ways).sum(axis=1, keepdims=True)
            normals = np.where(facing > -1e-3, normals - (facing + 1e-3) * ways, normals)
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            narrow = (a.astype(np.float32) for a in (points + lift * normals, normals, ways, values[:, 3:]))
            at = SurfaceInteractions(*(np.ascontiguousarray(a) for a in narrow))
            pixels = (y[part] * covered.shape[1] + x[part]).astype(np.int64)
            sums[part] += tracer.radiance(at, pixels, np.full(len(pixels), sample))
    picture = np.zeros((*covered.shape, 3))
    picture[y, x] = sums / (side * side)
    return picture


def nearest_in(
    mask: Bool[np.ndarray, "h w"], y: Int64[np.ndarray, " n"], x: Int64[np.ndarray, " n"]
) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
    """The nearest pixels of a mask."""
    from scipy.ndimage import distance_transform_edt

    found = distance_transform_edt(~mask, return_distances=False, return_indices=True)
    return found[0][y, x].astype(np.int64), found[1][y, x].astype(np.int64)


def main() -> None:
    """Render, compare, print a line a picture and the means."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("--views", type=int, default=3, help="so many, evenly spread")
    parser.add_argument("--samples", type=int, default=64, help="a pixel; a square number")
    parser.add_argument("--max-bounces", type=int, default=6, help="most surfaces on a path")
    parser.add_argument("--relit", action="store_true", help="also under the maps of the relit pictures")
    parser.add_argument("--gaussians", action="store_true", help="camera rays meet the Gaussians too")
    parser.add_argument("--pictures", type=Path, help="write pictures there")
    given = parser.parse_args()
    truth = read_ground_truth(given.scene / "truth.json")
    viewpoints = load_dataset_model(given.scene / "test", min_views=1, for_training=False)
    shots = view_shots(viewpoints, np.arange(len(viewpoints.views)))
    buffers = {}
    for view, shot in zip(viewpoints.views, shots, strict=True):
        known = truth.view(view.name, (view.height_px, view.width_px))
        buffers[view.name] = Buffer(known, shot.rays(), view.rotation_cam_from_world[2])
    all_points, all_values = (
        np.concatenate(p) for p in zip(*(b.points() for b in buffers.values()), strict=True)
    )
    spacing = SPACING * float(np.linalg.norm(np.ptp(all_points, axis=0))) / 2
    scene = gaussians_on(all_points, all_values, spacing)
    print(f"{len(scene):,} Gaussians, {spacing:.4f} apart", flush=True)
    relit = truth.content.relight.views
    names = [view.name for view in viewpoints.views]
    chosen = [name for name in names if name in relit] if given.relit else names
    chosen = chosen[:: max(1, len(chosen) // given.views)][: given.views]
    lights = [(given.scene / "test" / "images", truth.environment)]
    lights += list(truth.relit_folders) if given.relit else []
    settings = Integrator(
        samples=given.samples, max_depth=given.max_bounces, roulette_depth=given.max_bounces
    )
    for folder, environment in lights:
        assert environment is not None
        tracer = tracer_under(environment, scene, truth.up_world, settings, LIFT * spacing)
        values = [
            compare(given, truth, tracer, folder, name, buffers[name], shots[names.index(name)], spacing)
            for name in chosen
        ]
        print(f"{environment.stem}: mean {np.mean(values):.2f} dB of {len(values)} views", flush=True)


def compare(given, truth, tracer, folder, name, buffer, shot, spacing) -> float:  # type: ignore[no-untyped-def]
    """PSNR over black of one view."""
    began = time.process_time()
    true = read_image(folder / name)
    alpha = true[..., 3]
    if given.gaussians:
        image = tracer.render(shot.rays()).image().rgb_srgb.astype(np.float64)
    else:
        linear = picture_from(buffer, alpha, tracer, given.samples, LIFT * spacing)
        image = linear_to_srgb(np.clip(linear, 0, 1)) * alpha[..., None]
    wanted = true[..., :3] * alpha[..., None]
    whole = pooled_psnr(image.reshape(-1, 3), wanted.reshape(-1, 3))
    front = pooled_psnr(image[alpha > 0.5], wanted[alpha > 0.5])
    inner = np.minimum.reduce([np.roll(alpha, s, axis=a) for a in (0, 1) for s in (-2, -1, 0, 1, 2)]) == 1
    inside = pooled_psnr(image[inner], wanted[inner])
    print(
        f"  {folder.parent.name}/{folder.name}/{name}: {whole:.2f} dB, foreground {front:.2f}, two pixels "
        f"off outlines {inside:.2f}; {time.process_time() - began:.0f} s of CPU",
        flush=True,
    )
    if given.pictures is not None:
        both = np.concatenate([wanted, image, np.clip(np.abs(image - wanted) * 5, 0, 1)], axis=1)
        write_png(given.pictures / f"{folder.name}_{name}", both.astype(np.float32))
    return whole


if __name__ == "__main__":
    main()
