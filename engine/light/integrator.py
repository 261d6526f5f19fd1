"""The path tracer: waves of rays through meshes and Gaussians, from surface to surface."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from queue import Queue
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from octasplat.engine.light.arrays import (
    BLOCK,
    Paths,
    Rules,
    Scratch,
    ShadowRays,
    SurfacePoints,
    View,
    new_paths,
    new_scratches,
    new_shadow_rays,
)
from octasplat.engine.light.denoising import denoiser
from octasplat.engine.light.film import Film
from octasplat.engine.light.kernels_follow import follow_paths
from octasplat.engine.light.kernels_layer import add_layer_light, meet_layers
from octasplat.engine.light.kernels_material_layer import meet_materials, start_at_points
from octasplat.engine.light.kernels_path import add_lit, meet_surfaces, start_paths
from octasplat.engine.light.kernels_shadows import let_through
from octasplat.engine.light.layers import GaussianLayers
from octasplat.engine.light.stage import Integrator, Stage
from octasplat.engine.light.staging import LitMeshes, stage_meshes
from octasplat.engine.rays import ImageRays, RayBatch
from octasplat.engine.render.renderer import tile_order
from octasplat.engine.threads import use_threads
from octasplat.engine.trace.protocol import Tracer

PATHS_AT_ONCE = 1 << 18
"""Paths that are traced together through Gaussians."""
PATHS_OF_A_THREAD = 1 << 14
"""Paths that a thread follows by itself among meshes alone."""
LEAST_TILE = 64
LEAST_ROWS = 8192
NO_END = np.full(1, np.inf, np.float32)

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
        self._scratches = new_scratches(self._threads)
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
        return Film(
            image.height_px, image.width_px, layered=self._plate is not None, guided=self._clean is not None
        )

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
        together = PATHS_OF_A_THREAD if self._scene.layers is None else PATHS_AT_ONCE
        # Always the same cut, as what is traced together may differ in the last digit.
        at_once = min(count, together // LEAST_TILE)
        pixels = together // at_once // LEAST_TILE * LEAST_TILE
        tops = range(0, len(order), pixels)
        blocks = range(0, count, at_once)
        done, whole = 0, len(tops) * len(blocks)
        for sample in blocks:
            batches = [
                _Batch(top, order[top : top + pixels], min(at_once, count - sample), first + sample)
                for top in tops
            ]
            work = self._follow_in_waves if self._scene.layers is not None else self._follow_side_by_side
            for _ in work(film, view, order, image.rays.t_min[:1], batches):
                progress(done, whole)
                done += 1
        progress(whole, whole)

    def _follow_side_by_side(
        self,
        film: Film,
        view: View,
        order: Int64[np.ndarray, " n"],
        near: Float32[np.ndarray, "1"],
        batches: list["_Batch"],
    ) -> Iterator[None]:
        """Follow paths among meshes alone, a batch a thread; yields before each batch that is waited for."""
        meshes = self._scene.meshes
        given = (meshes.queries, meshes.surfaces, meshes.materials, meshes.lights)
        environment = meshes.lights.environment_number
        free: Queue[_Room] = Queue()
        for scratch in self._scratches:
            free.put(_Room.of(scratch))

        def work(batch: _Batch) -> None:
            room = free.get()
            try:
                paths = room.paths(len(batch.pixels) * batch.each)
                follow_paths(
                    len(paths.keys), room.scratch, view, self._rules, batch.top, batch.each,
                    batch.first_sample, order, near, NO_END, paths, room.active, room.distances, room.faces,
                    room.barycentrics, *given, environment, room.shadows, room.share,
                )  # fmt: skip
                film.add(paths, batch.pixels)
            finally:
                free.put(room)

        tasks = [self._pool.submit(work, batch) for batch in batches]
        try:
            for task in tasks:
                yield
                task.result()
        finally:
            for task in tasks:
                task.cancel()

    def _follow_in_waves(
        self,
        film: Film,
        view: View,
        order: Int64[np.ndarray, " n"],
        near: Float32[np.ndarray, "1"],
        batches: list["_Batch"],
    ) -> Iterator[None]:
        """Follow paths among Gaussians, all threads on one batch; yields before each."""
        for batch in batches:
            yield
            paths = new_paths(len(batch.pixels) * batch.each)
            self._share(
                start_paths, len(paths.keys), view, self._rules, batch.top, batch.each, batch.first_sample,
                order, paths,
            )  # fmt: skip
            self._follow(paths, near)
            film.add(paths, batch.pixels)

    def radiance(
        self, at: SurfacePoints, pixels: Int64[np.ndarray, " n"], samples: Int64[np.ndarray, " n"]
    ) -> Float32[np.ndarray, "n 3"]:
        """What points of surfaces send to who sees them, each by one path: linear, unbiased.

        The surface of a point is not part of the scene unless that holds it too.

        Args:
            at: the points.
            pixels: any number for each; with its sample it decides the path.
            samples: number of each path among those of its pixel, below 65,536.
        """
        use_threads(self._threads)
        meshes, layers = self._scene.meshes, self._scene.layers
        count = len(at.points_world)
        paths, shadows = new_paths(count), new_shadow_rays(count)
        self._share(
            start_at_points, count, at, pixels, samples, self._rules, meshes.materials, meshes.lights,
            paths, shadows,
        )  # fmt: skip
        every = np.arange(count, dtype=np.int32)
        self._add_surface_light(paths, every, shadows, None if layers is None else layers.tracer)
        self._follow(paths, np.zeros(1, np.float32), every[paths.alive], met=1)
        return paths.radiance_linear

    def _follow(
        self,
        paths: Paths,
        near: Float32[np.ndarray, "1"],
        active: Int32[np.ndarray, " n"] | None = None,
        met: int = 0,
    ) -> None:
        """Follow paths to their ends; the camera sees nothing nearer than ``near``.

        ``active`` are those that are left after they ``met`` so many surfaces; None stands for all.
        """
        meshes, layers = self._scene.meshes, self._scene.layers
        environment = meshes.lights.environment_number
        active = np.arange(len(paths.keys), dtype=np.int32) if active is None else active
        for depth in range(met, self._rules.max_depth + 1):
            rays = RayBatch(
                paths.origins_world if depth == 0 else paths.origins_world[active],
                paths.directions_world if depth == 0 else paths.directions_world[active],
                near if depth == 0 else 0.0,
                t_viewer=0.0 if depth == 0 else paths.viewers[active],
            )
            hits = meshes.triangles.closest(rays)
            shadows = new_shadow_rays(len(active))
            if layers is not None:
                seen = layers.trace(rays, hits.distances)
                if layers.with_materials:
                    self._share(
                        meet_materials, len(active), paths, active, depth, hits.faces, seen.rgb_srgb,
                        seen.transmittance, seen.depth_median, seen.depth_sum, seen.normal_world,
                        seen.features, meshes.materials, meshes.lights, self._rules, layers.spent_below,
                        shadows,
                    )  # fmt: skip
                    self._add_surface_light(paths, active, shadows, layers.tracer)
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
            self._add_surface_light(paths, active, shadows, None if layers is None else layers.on_meshes)
            active = active[paths.alive[active]]
            if len(active) == 0:
                return

    def _let_through(self, shadows: ShadowRays, *, through_frost: bool = False) -> Float32[np.ndarray, "n 3"]:
        """The share of light that meshes let through on each ray."""
        meshes, share = self._scene.meshes, np.empty_like(shadows.lit)
        self._share(
            let_through, len(share), meshes.queries, meshes.surfaces, meshes.materials, shadows,
            through_frost, share,
        )  # fmt: skip
        return share

    def _add_surface_light(
        self, paths: Paths, active: Int32[np.ndarray, " n"], shadows: ShadowRays, casters: Tracer | None
    ) -> None:
        """Add the light that reaches surfaces past meshes and the Gaussians of ``casters``."""
        shadows.lost[:] = 0.0
        share = self._let_through(shadows)
        free = np.flatnonzero(share.any(axis=1))
        if casters is not None and len(free):
            share[free] *= casters.transmittance(_rays(shadows, free))[:, None]
        self._share(add_lit, len(active), paths, active, shadows.lit, share)

    def _add_layer_light(
        self, paths: Paths, active: Int32[np.ndarray, " n"], shadows: ShadowRays, layers: GaussianLayers
    ) -> None:
        """Add the light that reaches layers of Gaussians, and take what meshes keep off them."""
        asked = np.flatnonzero(shadows.lit.any(axis=1) | shadows.lost.any(axis=1))
        if len(asked) == 0:
            return
        share = self._let_through(shadows, through_frost=True)[asked]
        free, whole = share.any(axis=1), (share == 1.0).all(axis=1)
        through = np.ones((2, len(asked)), np.float32)
        for row, tracer in enumerate((layers.on_gaussians, layers.not_on_gaussians)):
            # What nobody keeps off needs no tracing where nothing else would count it.
            needed = free if row == 0 else ~whole | (layers.on_gaussians is not None)
            if tracer is not None and needed.any():
                through[row, needed] = tracer.transmittance(_rays(shadows, asked[needed], layers.shadow_bias))
        self._share(
            add_layer_light, len(asked), paths, active[asked], shadows.lit[asked], shadows.lost[asked],
            share, through[0], through[1],
        )  # fmt: skip

    def _share(self, kernel: Callable[..., None], rows: int, *arguments: object) -> None:
        """Let all threads work on the rows of a kernel. Numba's own loops cannot write to named tuples."""
        parts = max(1, min(self._threads, rows // LEAST_ROWS))
        cuts = [rows * part // parts for part in range(parts + 1)]
        work = zip(pairwise(cuts), self._scratches, strict=False)
        if parts == 1:
            kernel(0, rows, self._scratches[0], *arguments)
            return
        tasks = [self._pool.submit(kernel, *cut, scratch, *arguments) for cut, scratch in work]
        for task in tasks:
            task.result()


class _Batch(NamedTuple):
    """Paths that are followed together: ``each`` of the pixels from place ``top`` on in their order."""

    top: int
    pixels: Int64[np.ndarray, " n"]
    each: int
    first_sample: int


@dataclass(frozen=True)
class _Room:
    """Where one thread keeps the paths that it follows, taken once as fresh memory costs time."""

    scratch: Scratch
    whole: Paths
    shadows: ShadowRays
    active: Int32[np.ndarray, " b"]
    distances: Float32[np.ndarray, " b"]
    faces: Int32[np.ndarray, " b"]
    barycentrics: Float32[np.ndarray, "b 2"]
    share: Float32[np.ndarray, "b 3"]

    @classmethod
    def of(cls, scratch: Scratch) -> "_Room":
        return cls(
            scratch, new_paths(PATHS_OF_A_THREAD), new_shadow_rays(BLOCK), np.empty(BLOCK, np.int32),
            np.empty(BLOCK, np.float32), np.empty(BLOCK, np.int32), np.empty((BLOCK, 2), np.float32),
            np.empty((BLOCK, 3), np.float32),
        )  # fmt: skip

    def paths(self, count: int) -> Paths:
        """The first so many paths."""
        return Paths(*(values[:count] for values in self.whole))


def _rays(shadows: ShadowRays, which: Int64[np.ndarray, " n"], t_min: float = 0.0) -> RayBatch:
    """Some of the shadow rays."""
    return RayBatch(
        shadows.origins_world[which], shadows.directions_world[which], t_min, shadows.t_max[which]
    )


def _axis(directions_world: Float32[np.ndarray, "h w 3"]) -> Float64[np.ndarray, "3"]:
    """The direction through the middle of the picture."""
    height, width = directions_world.shape[:2]
    middle = directions_world[(height - 1) // 2 : height // 2 + 1, (width - 1) // 2 : width // 2 + 1]
    axis = middle.reshape(-1, 3).mean(axis=0, dtype=np.float64)
    return np.asarray(axis / np.linalg.norm(axis))
