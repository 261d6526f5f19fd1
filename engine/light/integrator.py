"""The path tracer: waves of rays through meshes and Gaussians, from surface to surface."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int32

from engine.light.arrays import Paths, Rules, ShadowRays, View, new_paths, new_shadow_rays
from engine.light.denoising import denoiser
from engine.light.film import Film
from engine.light.kernels_layer import add_layer_light, meet_layers
from engine.light.kernels_path import add_lit, meet_surfaces, start_paths
from engine.light.layers import GaussianLayers
from engine.light.shadows import let_through, shadow_rays
from engine.light.stage import Integrator, Stage
from engine.light.staging import LitMeshes, stage_meshes
from engine.rays import ImageRays, RayBatch
from engine.render.renderer import tile_order
from engine.threads import use_threads

PATHS_AT_ONCE = 1 << 18
LEAST_TILE = 64
LEAST_ROWS = 8192

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class LitScene:
    """Everything that a ray can meet.

    Attributes:
        meshes: with materials, lights and surroundings.
        layers: the Gaussians; None without any.
        background_linear: radiance from where there is neither a mesh, nor Gaussians, nor an environment.
        surroundings: the environment without meshes and lights, for the plate of layered pictures.
    """

    meshes: LitMeshes
    layers: GaussianLayers | None = None
    background_linear: Float64[np.ndarray, "3"] | None = None
    surroundings: LitMeshes | None = None


class PathTracer:
    """Traces paths through a scene of meshes, lights and Gaussians.

    A path is a pure function of the seed, its pixel and its number, so that the number of threads changes
    nothing.

    Args:
        scene: what there is.
        settings: how to trace.
        threads: for the kernels; 0 takes all.

    Raises:
        ConfigError: noise is to be taken away, and what can do so is not installed.
    """

    def __init__(self, scene: LitScene, settings: Integrator, *, threads: int = 0) -> None:
        self._scene = scene
        self._settings = settings
        self._threads = use_threads(threads)
        self._pool = ThreadPoolExecutor(self._threads)
        background = np.zeros(3) if scene.background_linear is None else scene.background_linear
        self._rules = Rules(
            settings.seed,
            settings.max_depth,
            settings.roulette_depth,
            np.inf if settings.clamp is None else settings.clamp,
            settings.anti_aliasing,
            scene.meshes.environment_visible,
            background.astype(np.float64),
        )
        self._clean = denoiser() if settings.denoise else None
        self._plate: PathTracer | None = None
        if settings.layers:
            plain = settings.model_copy(update={"layers": False, "denoise": False})
            empty = scene.surroundings or stage_meshes(Stage(), Path(), threads=threads)
            alone = LitScene(empty, scene.layers, scene.background_linear)
            self._plate = PathTracer(alone, plain, threads=threads)

    def render(
        self,
        image: ImageRays,
        progress: Progress = lambda _done, _total: None,
    ) -> Film:
        """All samples of a picture.

        Args:
            image: rays through the centres of its pixels.
            progress: told (batches done, batches in all).
        """
        film = self._new_film(image)
        self.add_samples(film, image, 0, self._settings.samples, progress)
        return self._finished(film)

    def refine(self, image: ImageRays) -> Iterator[Film]:
        """The same film again and again, each time with about twice as many samples, until it has all."""
        film = self._new_film(image)
        done = 0
        while done < self._settings.samples:
            more = min(max(1, done), self._settings.samples - done)
            self.add_samples(film, image, done, more)
            done += more
            yield self._finished(film)

    def _new_film(self, image: ImageRays) -> Film:
        return Film(image.height_px, image.width_px, layered=self._plate is not None)

    def _finished(self, film: Film) -> Film:
        return film if self._clean is None else film.denoised(self._clean)

    def add_samples(
        self,
        film: Film,
        image: ImageRays,
        first: int,
        count: int,
        progress: Progress = lambda _done, _total: None,
    ) -> None:
        """Add the samples ``first`` to ``first + count`` of every pixel to a film."""
        if self._plate is not None and film.plate is not None:
            self._plate.add_samples(film.plate, image, first, count)
        use_threads(self._threads)
        view = View(
            image.origin_world.astype(np.float64),
            image.directions_world,
            _axis(image.directions_world),
            self._settings.aperture,
            self._settings.focus_distance or 1.0,
        )
        order = tile_order(image.height_px, image.width_px)
        # Always the same cut, as what is traced together may differ in the last digit.
        at_once = min(count, PATHS_AT_ONCE // LEAST_TILE)
        pixels = PATHS_AT_ONCE // at_once // LEAST_TILE * LEAST_TILE
        cuts = [
            (top, min(pixels, len(order) - top), sample, min(at_once, count - sample))
            for sample in range(0, count, at_once)
            for top in range(0, len(order), pixels)
        ]
        for number, (top, many, sample, each) in enumerate(cuts):
            progress(number, len(cuts))
            paths = new_paths(many * each)
            self._share(start_paths, many * each, view, self._rules, top, each, first + sample, order, paths)
            self._follow(paths, image.rays.t_min[:1])
            film.add(paths, order[top : top + many])
        progress(len(cuts), len(cuts))

    def _follow(self, paths: Paths, near: Float32[np.ndarray, "1"]) -> None:
        """Follow paths to their ends; the camera sees nothing nearer than ``near``."""
        meshes, layers = self._scene.meshes, self._scene.layers
        environment = meshes.lights.environment_number
        active = np.arange(len(paths.keys), dtype=np.int32)
        for depth in range(self._rules.max_depth + 1):
            rays = RayBatch(
                paths.origins_world if depth == 0 else paths.origins_world[active],
                paths.directions_world if depth == 0 else paths.directions_world[active],
                near if depth == 0 else 0.0,
            )
            hits = meshes.triangles.closest(rays)
            shadows = new_shadow_rays(len(active))
            if layers is not None:
                seen = layers.trace(rays, hits.distances)
                self._share(
                    meet_layers, len(active), paths, active, depth, hits.distances, hits.faces,
                    seen.rgb_srgb, seen.transmittance, seen.depth_median, seen.depth_sum, seen.normal_world,
                    seen.features, meshes.lights, environment, self._rules, meshes.materials.absorption,
                    layers.spent_below, shadows,
                )  # fmt: skip
                self._add_layer_light(paths, active, shadows, layers)
            self._share(
                meet_surfaces, len(active),
                paths, active, depth, hits.distances, hits.faces, hits.barycentrics,
                meshes.surfaces, meshes.materials, meshes.lights, environment, self._rules, shadows,
            )  # fmt: skip
            self._add_surface_light(paths, active, shadows)
            active = active[paths.alive[active]]
            if len(active) == 0:
                return

    def _add_surface_light(self, paths: Paths, active: Int32[np.ndarray, " n"], shadows: ShadowRays) -> None:
        """Add the light that reaches surfaces."""
        asked = np.flatnonzero(shadows.lit.any(axis=1))
        if len(asked) == 0:
            return
        share = let_through(self._scene.meshes, shadows, asked)
        layers = self._scene.layers
        free = share.any(axis=1)
        if layers is not None and layers.on_meshes is not None and free.any():
            share[free] *= layers.on_meshes.transmittance(shadow_rays(shadows, asked[free]))[:, None]
        self._share(add_lit, len(asked), paths, active[asked], shadows.lit[asked], share)

    def _add_layer_light(
        self, paths: Paths, active: Int32[np.ndarray, " n"], shadows: ShadowRays, layers: GaussianLayers
    ) -> None:
        """Add the light that reaches layers of Gaussians, and take what meshes keep off them."""
        asked = np.flatnonzero(shadows.lit.any(axis=1) | shadows.lost.any(axis=1))
        if len(asked) == 0:
            return
        share = let_through(self._scene.meshes, shadows, asked, through_frost=True)
        free, whole = share.any(axis=1), (share == 1.0).all(axis=1)
        through = np.ones((2, len(asked)), np.float32)
        for row, tracer in enumerate((layers.on_gaussians, layers.not_on_gaussians)):
            # What nobody keeps off needs no tracing where nothing else would count it.
            needed = free if row == 0 else ~whole | (layers.on_gaussians is not None)
            if tracer is not None and needed.any():
                rays = shadow_rays(shadows, asked[needed], layers.shadow_bias)
                through[row, needed] = tracer.transmittance(rays)
        self._share(
            add_layer_light, len(asked), paths, active[asked], shadows.lit[asked], shadows.lost[asked],
            share, through[0], through[1],
        )  # fmt: skip

    def _share(self, kernel: Callable[..., None], rows: int, *arguments: object) -> None:
        """Let all threads work on the rows of a kernel. Numba's own loops cannot write to named tuples."""
        parts = max(1, min(self._threads, rows // LEAST_ROWS))
        cuts = [rows * part // parts for part in range(parts + 1)]
        if parts == 1:
            kernel(0, rows, *arguments)
            return
        tasks = [self._pool.submit(kernel, *cut, *arguments) for cut in pairwise(cuts)]
        for task in tasks:
            task.result()


def _axis(directions_world: Float32[np.ndarray, "h w 3"]) -> Float64[np.ndarray, "3"]:
    """The direction through the middle of the picture."""
    height, width = directions_world.shape[:2]
    middle = directions_world[(height - 1) // 2 : height // 2 + 1, (width - 1) // 2 : width // 2 + 1]
    axis = middle.reshape(-1, 3).mean(axis=0, dtype=np.float64)
    return np.asarray(axis / np.linalg.norm(axis))
