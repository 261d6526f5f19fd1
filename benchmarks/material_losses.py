"""Where a finished run with materials loses what it loses: truths put in, alone and in pairs, by region.

    octasplat reconstruct PHOTOS -o RUN --materials
    python -m benchmarks.material_losses RUN PHOTOS            # PHOTOS/truth.json, its views in PHOTOS/test
    python -m benchmarks.material_losses RUN PHOTOS --brief    # the run alone

What is put in is taken by the pixels of the test views and by all that reflected rays meet: there the truth
comes from the points of the true maps, as in ``benchmarks.material_ceiling``. Nothing is trained again, so an
error that another one had made up for shows once that other is mended. Four rays a pixel, split sums, their
mean as display values over black; the row that is true in all parts is what split sums can reach.

Regions, by the truth: ``edges`` within two pixels of outlines, outer ones and those of one part before
another; of the rest ``self`` where a smooth surface mirrors the thing itself, ``mirror`` smooth metal,
``rough`` other metal, ``glossy`` smooth surfaces that are no metal, and ``matt``. What is missing to 100 % of
the error lies where the background is to be seen.
"""

import argparse
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from benchmarks.material_ceiling import Buffer, gaussians_on, nearest_in
from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.core.rays import ImageRays, RayBatch
from octasplat.engine.core.threads import use_threads
from octasplat.engine.dataset import PosedView, load_dataset_model
from octasplat.engine.evaluate.ground_truth import GroundTruth, read_ground_truth
from octasplat.engine.evaluate.ground_truth_metrics import normal_angles_degrees, pooled_psnr
from octasplat.engine.files import read_scene
from octasplat.engine.gaussians.channels import stack_channels
from octasplat.engine.gaussians.frames import quaternions_from_matrices
from octasplat.engine.gaussians.materials import AMBIENT, DIFFUSE_INTERREFLECTION, MATERIAL_WIDTHS
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.environment_files import read_environment
from octasplat.engine.render.image_files import read_image
from octasplat.engine.render.shots import view_shots
from octasplat.engine.runs.config import read_config
from octasplat.engine.runs.run_folder import CONFIG, SCENE, run_environment, run_extent
from octasplat.engine.shading.deferred import DeferredShading
from octasplat.engine.shading.material_settings import MaterialSettings
from octasplat.engine.shading.protocol import TracedRays
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import Tracer, TraceResult, TraceSettings

PARTS = ("geometry", "normals", "materials", "environment")
REGIONS = ("mirror", "rough", "glossy", "matt", "self", "edges")
SMOOTH = 0.3
"""Roughness below which a surface is smooth."""
SPACING = 0.01
"""Least distance of the Gaussians on true points, of the scene's radius."""
EDGE_BEND = 0.01
"""Relative second difference of the inverse depths of neighbouring pixels that makes an edge."""
LIFT = 2.0
"""Distance of reflected rays' beginnings from the true surface, of the distance of the Gaussians there."""


@dataclass(frozen=True)
class Sample:
    """One ray a pixel of a view, row by row, and what is true along it.

    Attributes:
        rays: through the same part of each pixel.
        depth: along the ray, world units; that of the nearest pixel of the mask outside it.
        values: unit normal, albedo, metallic and roughness there.
    """

    rays: RayBatch
    depth: Float64[np.ndarray, " p"]
    values: Float64[np.ndarray, "p 8"]


@dataclass(frozen=True)
class View:
    """A test view with what is true of each of its pixels, row by row.

    Attributes:
        samples: rays, evenly spread over each pixel.
        wanted: the picture over black, display values.
        alpha: share of each pixel that the thing covers.
        normals: unit normals at the centres.
        region: number in ``REGIONS``; -1 for the background.
    """

    samples: tuple[Sample, ...]
    wanted: Float64[np.ndarray, "p 3"]
    alpha: Float64[np.ndarray, " p"]
    normals: Float64[np.ndarray, "p 3"]
    region: Int64[np.ndarray, " p"]


class TrueSurface:
    """Gaussians on the true points of all views, and the values of these points."""

    def __init__(self, buffers: Sequence[Buffer]) -> None:
        points, values = zip(*(buffer.points() for buffer in buffers), strict=True)
        self.points, self.values = np.concatenate(points), np.concatenate(values)
        # not finer than the pixels, whose points would leave gaps
        middle = [buffer.rays[len(buffer.rays) // 2] for buffer in buffers]
        angle = max(float(np.linalg.norm(row[len(row) // 2] - row[len(row) // 2 - 1])) for row in middle)
        pixel = angle * max(float(np.median(buffer.depth[buffer.mask])) for buffer in buffers)
        self.spacing = max(SPACING * float(np.linalg.norm(np.ptp(self.points, axis=0))) / 2, pixel)
        self.gaussians = gaussians_on(self.points, self.values, self.spacing)
        self._tree = cKDTree(self.points)

    def nearest(self, means_world: np.ndarray) -> Float64[np.ndarray, "n 8"]:
        """Return the values of the true points nearest to others."""
        return self.values[self._tree.query(means_world)[1]]


class Run:
    """A finished run, and what it would show with truths put in.

    Args:
        folder: of the run.
        truth: of its scene.
        surface: the true one.
        threads: 0 takes all cores.
    """

    def __init__(self, folder: Path, truth: GroundTruth, surface: TrueSurface, threads: int) -> None:
        config = read_config(folder / CONFIG).train
        self._gaussians, _ = read_scene(folder / SCENE)
        self._settings, self._trace, self._threads = config.materials, config.trace, threads
        self._surface, self._extent = surface, run_extent(folder, 1.0)
        assert truth.environment is not None
        self._maps = {
            False: read_environment(run_environment(folder)),
            True: read_environment(truth.environment),
        }
        self.tracer, self._shading = self._ready(frozenset())

    def _ready(self, true: frozenset[str]) -> tuple[Tracer, DeferredShading]:
        """Return the scene with these parts of the truth, and its shading."""
        radiance = self._maps["environment" in true]
        settings: MaterialSettings = self._settings.model_copy(
            update={"environment_height": len(radiance), "depth_split": 0.0}
        )
        trace: TraceSettings = self._trace
        if "geometry" in true:
            bias = LIFT * self._surface.spacing / self._extent
            settings = settings.model_copy(update={"ray_bias": bias, "backface_cull_distance": 4 * bias})
        shading = DeferredShading(settings, extent_world=self._extent, one_sided=trace.flip_normal_cos > 0)
        shading.light.set_radiance(radiance)
        scene = self._scene(true)
        tracer = make_tracer(trace, threads=self._threads)
        tracer.build(scene, shading.features(scene))
        if true:  # light from all around follows from all parts
            ids = np.arange(len(scene))
            open_side = shading.measure_ambient_occlusion(scene, ids, tracer)
            tracer.build(scene, shading.features(scene))
            shading.measure_diffuse_interreflection(scene, ids, open_side, tracer)
            tracer.build(scene, shading.features(scene))
        return tracer, shading

    def _scene(self, true: frozenset[str]) -> FlatGaussians:
        """Return Gaussians of the run or the true surface, with the run's or true normals and materials."""
        own, surface = self._gaussians, self._surface
        channels = {name: own.channels[name] for name in (*MATERIAL_WIDTHS, AMBIENT, DIFFUSE_INTERREFLECTION)}
        materials = stack_channels(own.channels, list(MATERIAL_WIDTHS))
        learnt = np.concatenate([own.rotations[:, :, 0], materials], axis=1)
        if "geometry" in true:
            scene = surface.gaussians.copy()
            solid = np.flatnonzero(own.opacities > 0.5)
            near = solid[cKDTree(own.means_world[solid]).query(scene.means_world)[1]]
            channels = {name: values[near] for name, values in channels.items()}
            values = {False: learnt[near].astype(np.float64), True: surface.nearest(scene.means_world)}
        else:
            scene = own.copy()
            values = {False: learnt.astype(np.float64), True: surface.nearest(own.means_world)}
        if ("normals" in true) != ("geometry" in true):  # else the scene has them
            scene.quats_wxyz = turned_to(scene, values["normals" in true][:, :3])
        first = 3
        for name, width in MATERIAL_WIDTHS.items():
            channels[name] = values["materials" in true][:, first : first + width].astype(np.float32)
            first += width
        return scene.with_channels({name: np.ascontiguousarray(v) for name, v in channels.items()})

    def pictures(self, true: frozenset[str], views: list[View]) -> list[Float64[np.ndarray, "p 3"]]:
        """Return the display colors of all views over black with these parts of the truth."""
        tracer, shading = self._ready(true) if true else (self.tracer, self._shading)
        found = []
        for view in views:
            light, coverage = np.zeros_like(view.wanted), np.zeros_like(view.alpha)
            for sample in view.samples:
                learnt, scene = self.tracer.trace(sample.rays), tracer.trace(sample.rays)
                result = substituted(view, sample, learnt, scene, true)
                shaded = shading.shade(TracedRays(sample.rays, result, tracer))
                light += result.alpha[:, None] * shaded.layers["linear"]
                coverage += result.alpha
            mean = light / np.maximum(coverage, 1e-6)[:, None]
            alpha = coverage[:, None] / len(view.samples)
            found.append(linear_to_srgb(np.clip(mean, 0, 1)) * alpha)
        return found

    def surface_errors(self, view: View) -> dict[str, Float64[np.ndarray, " p"]]:
        """Return how far the mean normals and materials of pixels are from the true ones, by name."""
        results = [self.tracer.trace(sample.rays) for sample in view.samples]
        normal = sum(result.normal_world.astype(np.float64) for result in results)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        weight = np.maximum(sum(result.alpha.astype(np.float64) for result in results), 1e-6)
        material = sum(result.features[:, :5].astype(np.float64) for result in results) / weight[:, None]
        true = sum(sample.values[:, 3:] for sample in view.samples) / len(view.samples)
        off = np.abs(material - true)
        return {
            "normals, degrees": normal_angles_degrees(normal, view.normals),
            "albedo, % off": 100 * off[:, :3].mean(axis=1),
            "metallic, % off": 100 * off[:, 3],
            "roughness, % off": 100 * off[:, 4],
        }


def turned_to(gaussians: FlatGaussians, normals: Float64[np.ndarray, "n 3"]) -> np.ndarray:
    """Return the quaternions of Gaussians after the least turn of their normals to others."""
    frames = gaussians.rotations.astype(np.float64)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    second = frames[:, :, 1] - (frames[:, :, 1] * normals).sum(axis=1, keepdims=True) * normals
    second /= np.maximum(np.linalg.norm(second, axis=1, keepdims=True), 1e-12)
    axes = np.stack([normals, second, np.cross(normals, second)], axis=-1)
    return quaternions_from_matrices(axes).astype(np.float32)


def substituted(
    view: View, sample: Sample, learnt: TraceResult, scene: TraceResult, true: frozenset[str]
) -> TraceResult:
    """Return what camera rays show: the run's own blend, with the parts that are true from the maps."""
    own = np.maximum(learnt.alpha, 1e-6)[:, None].astype(np.float64)
    alpha = view.alpha if "geometry" in true else learnt.alpha.astype(np.float64)
    depth = sample.depth if "geometry" in true else learnt.expected_depth.astype(np.float64)
    is_met = (learnt.alpha > 0.02)[:, None]
    normal = np.where(is_met, learnt.normal_world / own, -sample.rays.directions_world)
    material = np.where(is_met, learnt.features[:, :5] / own, 0.5)
    inside = (view.region >= 0)[:, None] if "geometry" not in true else np.ones_like(is_met)
    if "normals" in true:
        normal = np.where(inside, sample.values[:, :3], normal)
    if "materials" in true:
        material = np.where(inside, sample.values[:, 3:], material)
    around = scene.features[:, 5:] / np.maximum(scene.alpha, 1e-6)[:, None]
    features = np.concatenate([material, around], axis=1) * alpha[:, None]
    return replace(
        learnt,
        transmittance=(1 - alpha).astype(np.float32),
        depth_sum=(alpha * depth).astype(np.float32),
        normal_world=(alpha[:, None] * normal).astype(np.float32),
        features=features.astype(np.float32),
    )


def edges_of(depth: Float64[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the pixels within two of an outline or of a jump of the depth."""
    inverse = np.where(mask, 1 / np.where(mask, depth, 1.0), 0.0)
    jumps = np.zeros(mask.shape, bool)
    for axis in (0, 1):  # over a plane the inverse of the depth is linear
        bend = np.abs(np.roll(inverse, 1, axis) - 2 * inverse + np.roll(inverse, -1, axis))
        jumps |= bend > EDGE_BEND * np.maximum(inverse, inverse.max() / 4)
    return binary_dilation(jumps, np.ones((3, 3), bool))


def view_of(
    posed: PosedView,
    image: ImageRays,
    buffer: Buffer,
    picture: Float64[np.ndarray, "h w 4"],
    around: Tracer,
    lift: float,
) -> View:
    """Return a view with its truth; ``around`` holds the true surface."""
    height, width = buffer.mask.shape
    y, x = np.divmod(np.arange(height * width), width)
    at = nearest_in(buffer.mask, y, x)

    def sample(across: float, down: float) -> Sample:
        directions = image.shifted(across, down).directions_world.reshape(-1, 3)
        rays = RayBatch(np.broadcast_to(image.origin_world, directions.shape), directions)
        points, values, _ = buffer.within(*at, np.tile([down, across], (len(y), 1)))
        return Sample(rays, np.linalg.norm(points - image.origin_world, axis=1), values)

    centre = sample(0.0, 0.0)
    ways = centre.rays.directions_world.astype(np.float64)
    normals, metallic, roughness = centre.values[:, :3], centre.values[:, 6], centre.values[:, 7]
    mirrored = ways - 2 * (ways * normals).sum(axis=1, keepdims=True) * normals
    starts = image.origin_world + centre.depth[:, None] * ways + lift * normals
    hidden = around.transmittance(RayBatch(starts, mirrored.astype(np.float32), lift)) < 0.5
    metal, smooth, edges = metallic > 0.5, roughness < SMOOTH, edges_of(buffer.depth, buffer.mask).ravel()
    kinds = {
        "edges": edges,
        "self": hidden & smooth,
        "mirror": metal & smooth,
        "rough": metal,
        "glossy": smooth,
    }
    region = np.select(list(kinds.values()), [REGIONS.index(kind) for kind in kinds], REGIONS.index("matt"))
    alpha = picture[..., 3].ravel()
    region[(alpha == 0) | ~(buffer.mask.ravel() | (alpha > 0.5))] = -1
    samples = tuple(sample(across, down) for across in (-0.25, 0.25) for down in (-0.25, 0.25))
    return View(samples, picture[..., :3].reshape(-1, 3) * alpha[:, None], alpha, normals, region)


def row_of(pictures: list[np.ndarray], views: list[View]) -> list[float]:
    """Return PSNR of whole pictures, then of each region."""
    found, wanted = np.concatenate(pictures), np.concatenate([view.wanted for view in views])
    region = np.concatenate([view.region for view in views])
    chosen = [np.ones(len(region), bool), *(region == k for k in range(len(REGIONS)))]
    return [pooled_psnr(found[c], wanted[c]) if c.any() else float("nan") for c in chosen]


def table(rows: Mapping[str, list[float]], heads: Iterable[str]) -> str:
    """Return rows of numbers as a table in Markdown."""
    lines = ["| | " + " | ".join(heads) + " |"]
    lines.append("|" + "---|" * (lines[0].count("|") - 1))
    lines += [
        f"| {name} | " + " | ".join("-" if np.isnan(value) else f"{value:.1f}" for value in values) + " |"
        for name, values in rows.items()
    ]
    return "\n".join(lines)


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--views", type=int, default=4, help="so many, evenly spread")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--brief", action="store_true", help="nothing put in")
    given = parser.parse_args()
    use_threads(given.threads)
    truth = read_ground_truth(given.scene / "truth.json")
    model = load_dataset_model(given.scene / "test", min_views=1, for_training=False)
    shots = view_shots(model, np.arange(len(model.views)))
    buffers = [
        Buffer(truth.view(v.name, (v.height_px, v.width_px)), shot.rays(), v.rotation_cam_from_world[2])
        for v, shot in zip(model.views, shots, strict=True)
    ]
    surface = TrueSurface(buffers)
    solid = make_tracer(TraceSettings(), threads=given.threads)
    solid.build(surface.gaussians, np.zeros((len(surface.gaussians), 3), np.float32))
    pictures = given.scene / "test" / "images"
    triples = list(zip(model.views, shots, buffers, strict=True))
    views = [
        view_of(
            posed, shot.rays(), buffer, read_image(pictures / posed.name).astype(np.float64), solid,
            LIFT * surface.spacing,
        )
        for posed, shot, buffer in triples[:: max(1, len(triples) // given.views)][: given.views]
    ]  # fmt: skip
    run = Run(given.run, truth, surface, given.threads)
    region = np.concatenate([view.region for view in views])
    shown = run.pictures(frozenset(), views)
    squared = [((a - view.wanted) ** 2).sum(axis=1) for a, view in zip(shown, views, strict=True)]
    errors, off = np.concatenate(squared), [run.surface_errors(view) for view in views]
    parts = [region == k for k in range(len(REGIONS))]
    shares = {
        "share of the pixels, %": [100 * float(part.sum() / (region >= 0).sum()) for part in parts],
        "share of the squared error, %": [100 * float(errors[part].sum() / errors.sum()) for part in parts],
    }
    for name in off[0]:
        values = np.concatenate([found[name] for found in off])
        shares[name] = [float(values[part].mean()) if part.any() else np.nan for part in parts]
    print(table(shares, REGIONS), flush=True)
    rows = {"the run": row_of(shown, views)}
    if not given.brief:
        for count in (1, 2, 4):
            for parts in itertools.combinations(PARTS, count):
                rows[", ".join(parts)] = row_of(run.pictures(frozenset(parts), views), views)
    print(table(rows, ("all", *REGIONS)), flush=True)


if __name__ == "__main__":
    main()
