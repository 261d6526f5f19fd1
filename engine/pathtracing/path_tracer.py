"""The path tracer: wavefronts of rays through meshes and Gaussians, bounce by bounce."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from octasplat.engine.core.rays import ImageRays, RayBatch
from octasplat.engine.core.threads import use_threads
from octasplat.engine.pathtracing.compile_meshes import CompiledMeshes, compile_meshes
from octasplat.engine.pathtracing.denoising import load_denoiser
from octasplat.engine.pathtracing.film import Film
from octasplat.engine.pathtracing.gaussian_layers import GaussianLayers
from octasplat.engine.pathtracing.kernels.camera_paths import start_paths
from octasplat.engine.pathtracing.kernels.cutouts import pass_surfaces
from octasplat.engine.pathtracing.kernels.gaussian_layer import (
    LayerLight,
    add_layer_light,
    intersect_gaussian_layers,
)
from octasplat.engine.pathtracing.kernels.gaussian_surface import (
    intersect_gaussian_surfaces,
    start_paths_at_surfaces,
)
from octasplat.engine.pathtracing.kernels.kernel_args import IntegratorParameters, LayerArrays
from octasplat.engine.pathtracing.kernels.path_args import (
    Bounce,
    CameraRays,
    MeshHits,
    PathArrays,
    ShadowRayArrays,
    SurfaceInteractions,
    allocate_media,
    allocate_path_scratch,
    allocate_paths,
    allocate_shadow_rays,
)
from octasplat.engine.pathtracing.kernels.path_radiance import add_direct_light
from octasplat.engine.pathtracing.kernels.path_surfaces import shade_surfaces
from octasplat.engine.pathtracing.kernels.shadow_rays import shadow_transmittance
from octasplat.engine.pathtracing.mesh_paths import NO_BOXES, MeshPaths
from octasplat.engine.pathtracing.path_batches import (
    PATHS_PER_THREAD,
    Batch,
    ImageBatches,
    optical_axis,
    pixels_per_batch,
)
from octasplat.engine.pathtracing.stage.model import Integrator, Stage
from octasplat.engine.render.renderer import tile_order
from octasplat.engine.trace.protocol import Tracer

PATHS_PER_WAVE = 1 << 18
"""Paths that are traced together through Gaussians."""
MIN_TILE_PIXELS = 64
MIN_ROWS_PER_THREAD = 8192
MOST_NEAR_GAUSSIANS, BATCHES_WITHOUT_ATTEMPT = 0.5, 7
"""Share of pixels near Gaussians above which a batch was not worth its attempt without them, and number of
batches after it that go without one."""

ProgressCallback = Callable[[int, int], None]


@dataclass(frozen=True)
class PathTracerScene:
    """Everything that a ray can meet.

    Attributes:
        meshes: with materials, lights and surroundings.
        layers: the Gaussians; None without any.
        background_linear: radiance from where there is neither a mesh, nor Gaussians, nor an environment.
        environment_only: the environment without meshes and lights, for the plate of layered pictures.
    """

    meshes: CompiledMeshes
    layers: GaussianLayers | None = None
    background_linear: Float64[np.ndarray, "3"] | None = None
    environment_only: CompiledMeshes | None = None


class PathTracer:
    """Path tracer of a scene of meshes, lights and Gaussians.

    A path is a pure function of the seed, its pixel and its number, so that the number of threads changes
    nothing.

    Args:
        scene: what there is.
        settings: how to trace.
        threads: for the kernels; 0 takes all.

    Raises:
        ConfigError: noise is to be taken away, and what can do so is not installed.
    """

    def __init__(self, scene: PathTracerScene, settings: Integrator, *, threads: int = 0) -> None:
        self._scene = scene
        self._settings = settings
        self._threads = use_threads(threads)
        self._pool = ThreadPoolExecutor(self._threads)
        self._scratches = allocate_path_scratch(self._threads)
        background = np.zeros(3) if scene.background_linear is None else scene.background_linear
        self._integrator = IntegratorParameters(
            seed=settings.seed,
            max_depth=settings.max_depth,
            roulette_depth=settings.roulette_depth,
            clamp=np.inf if settings.clamp is None else settings.clamp,
            anti_aliasing=settings.anti_aliasing,
            environment_visible=scene.meshes.environment_visible,
            background_linear=background.astype(np.float64),
        )
        boxes = NO_BOXES if scene.layers is None else scene.layers.boxes
        self._mesh_paths = MeshPaths(scene.meshes, boxes, self._integrator, self._pool, self._scratches)
        self._denoise = load_denoiser() if settings.denoise else None
        self._plate: PathTracer | None = None
        if settings.layers:
            # a plate has no plate itself
            plain = settings.model_copy(update={"layers": False, "denoise": False})
            empty = scene.environment_only or compile_meshes(Stage(), Path(), threads=threads)
            alone = PathTracerScene(empty, scene.layers, scene.background_linear)
            self._plate = PathTracer(alone, plain, threads=threads)

    def render(
        self,
        image: ImageRays,
        progress: ProgressCallback = lambda _done, _total: None,
    ) -> Film:
        """Return a film with all samples of an image.

        Args:
            image: rays through the centres of its pixels.
            progress: called with (batches done, total).
        """
        film = self._make_film(image)
        self.add_samples(film, image, 0, self._settings.samples, progress)
        return self._denoise_film(film)

    def refine(self, image: ImageRays) -> Iterator[Film]:
        """Yield one film repeatedly, with about twice as many samples each time, until it has all."""
        film = self._make_film(image)
        done = 0
        while done < self._settings.samples:
            more = min(max(1, done), self._settings.samples - done)
            self.add_samples(film, image, done, more)
            done += more
            yield self._denoise_film(film)

    def _make_film(self, image: ImageRays) -> Film:
        return Film(
            image.height_px,
            image.width_px,
            has_layers=self._plate is not None,
            has_guides=self._denoise is not None,
        )

    def _denoise_film(self, film: Film) -> Film:
        return film if self._denoise is None else film.denoised(self._denoise)

    def add_samples(
        self,
        film: Film,
        image: ImageRays,
        first: int,
        count: int,
        progress: ProgressCallback = lambda _done, _total: None,
    ) -> None:
        """Add the samples ``first`` to ``first + count`` of every pixel to a film."""
        if self._plate is not None and film.plate is not None:
            self._plate.add_samples(film.plate, image, first, count)
        use_threads(self._threads)
        view = CameraRays(
            image.origin_world.astype(np.float64),
            image.directions_world,
            optical_axis(image),
            self._settings.aperture,
            self._settings.focus_distance or 1.0,
        )
        # neighboring pixels together: their rays form packets
        order = tile_order(image.height_px, image.width_px)
        # Always the same cut, as what is traced together may differ in the last digit.
        at_once = min(count, PATHS_PER_THREAD // MIN_TILE_PIXELS)
        pixels = PATHS_PER_WAVE // at_once // MIN_TILE_PIXELS * MIN_TILE_PIXELS
        if self._scene.layers is None:
            pixels = pixels_per_batch(len(order), at_once, self._threads)
        tops = range(0, len(order), pixels)
        blocks = range(0, count, at_once)
        done, total = 0, len(tops) * len(blocks)
        for sample in blocks:
            batches = [
                Batch(top, order[top : top + pixels], min(at_once, count - sample), first + sample)
                for top in tops
            ]
            work = self._trace_wavefront if self._scene.layers is not None else self._trace_per_thread
            for _ in work(film, ImageBatches(view, order, image.rays.t_min[:1], batches)):
                progress(done, total)
                done += 1
        progress(total, total)

    def _trace_per_thread(self, film: Film, image: ImageBatches) -> Iterator[None]:
        """Trace paths among meshes only, a batch per thread; yield before each batch that is awaited."""
        tasks = [
            self._mesh_paths.submit(film, image.start(batch), image.t_min, np.zeros(len(batch.pixels), bool))
            for batch in image.batches
        ]
        try:
            for task in tasks:
                yield  # callers report progress, or stop, before each wait
                task.result()
        finally:
            for task in tasks:
                task.cancel()

    def _trace_wavefront(self, film: Film, image: ImageBatches) -> Iterator[None]:
        """Trace paths among Gaussians, all threads on one batch; yield before each.

        Pixels whose paths come near to none are finished among the meshes alone, which costs less. Where
        those are few, the next batches do without the attempt.
        """
        skipped = 0
        for batch in image.batches:
            yield
            start, pixels = image.start(batch), batch.pixels
            if skipped == 0:
                near = self._mesh_paths.finish_far_pixels(film, start, image.t_min, len(pixels))
                skipped = BATCHES_WITHOUT_ATTEMPT if near.mean() > MOST_NEAR_GAUSSIANS else 0
                pixels = pixels[near]
                start = start._replace(pixel_order=pixels, first_pixel=0)
            else:
                skipped -= 1
            if len(pixels) == 0:
                continue
            paths = allocate_paths(len(pixels) * batch.paths_per_pixel)
            self._run_kernel(start_paths, len(paths.keys), self._integrator, start, paths)
            self._trace_paths(paths, image.t_min)
            film.add(paths, pixels)

    def radiance(
        self,
        interactions: SurfaceInteractions,
        pixels: Int64[np.ndarray, " n"],
        samples: Int64[np.ndarray, " n"],
    ) -> Float32[np.ndarray, "n 3"]:
        """Return the radiance that surface points send to their viewers, one path each: linear, unbiased.

        The surface of a point is not part of the scene unless that holds it too.

        Args:
            interactions: the points.
            pixels: any number for each; with its sample it decides the path.
            samples: number of each path among those of its pixel, below 65,536.
        """
        use_threads(self._threads)
        meshes, layers = self._scene.meshes, self._scene.layers
        count = len(interactions.points_world)
        paths, shadows = allocate_paths(count), allocate_shadow_rays(count)
        self._run_kernel(
            start_paths_at_surfaces, count, interactions, pixels, samples, self._integrator,
            meshes.materials, meshes.lights, paths, shadows,
        )  # fmt: skip
        every = np.arange(count, dtype=np.int32)
        self._add_surface_light(paths, every, shadows, None if layers is None else layers.tracer)
        # depth 0, the camera's ray, is replaced by the given points
        self._trace_paths(paths, np.zeros(1, np.float32), every[paths.is_alive], first_depth=1)
        return paths.radiance_linear

    def _trace_paths(
        self,
        paths: PathArrays,
        t_min: Float32[np.ndarray, "1"],
        active: Int32[np.ndarray, " n"] | None = None,
        first_depth: int = 0,
    ) -> None:
        """Trace paths to their ends; the camera sees nothing nearer than ``t_min``.

        ``active`` are those that are left after ``first_depth`` bounces; None stands for all.
        """
        meshes, layers, scene = self._scene.meshes, self._scene.layers, self._scene.meshes.scene
        active = np.arange(len(paths.keys), dtype=np.int32) if active is None else active
        for depth in range(first_depth, self._integrator.max_depth + 1):
            rays = RayBatch(
                paths.origins_world if depth == 0 else paths.origins_world[active],
                paths.directions_world if depth == 0 else paths.directions_world[active],
                t_min if depth == 0 else 0.0,
                t_view_origin=0.0 if depth == 0 else paths.t_view_origin[active],
            )
            hits = meshes.triangles.closest(rays)
            shadows, nested = allocate_shadow_rays(len(active)), len(active) if scene.any_nested else 0
            bounce = Bounce(
                paths=paths,
                active=active,
                depth=depth,
                hits=MeshHits(hits.distances, hits.faces, hits.barycentrics, allocate_media(nested)),
                scene=scene,
                integrator=self._integrator,
                shadows=shadows,
            )
            if meshes.queries.any_cutout or scene.any_nested:
                self._run_kernel(pass_surfaces, len(active), meshes.queries, bounce)
            if layers is not None:
                traced = layers.trace(rays, hits.distances)
                layer = LayerArrays(
                    rgb=traced.rgb_srgb,
                    transmittance=traced.transmittance,
                    depth_median=traced.depth_median,
                    depth_sum=traced.depth_sum,
                    normals=traced.normal_world,
                    features=traced.features,
                    min_transmittance=layers.min_transmittance,
                )
                # surfaces first: what of the layer has a material is taken out of it
                if layers.has_material_surfaces:
                    self._run_kernel(intersect_gaussian_surfaces, len(active), bounce, layer)
                    self._add_surface_light(paths, active, shadows, layers.tracer)
                self._run_kernel(intersect_gaussian_layers, len(active), bounce, layer)
                self._add_layer_light(paths, active, shadows, layers)
            self._run_kernel(shade_surfaces, len(active), bounce)
            self._add_surface_light(
                paths, active, shadows, None if layers is None else layers.mesh_shadow_tracer
            )
            # wavefronts shrink, so that later bounces trace only what is left
            active = active[paths.is_alive[active]]
            if len(active) == 0:
                return

    def _shadow_transmittance(
        self, shadows: ShadowRayArrays, *, passes_rough_glass: bool = False
    ) -> Float32[np.ndarray, "n 3"]:
        """Return the transmittance of meshes along each shadow ray."""
        meshes, share = self._scene.meshes, np.empty_like(shadows.radiance_linear)
        self._run_kernel(
            shadow_transmittance, len(share), meshes.queries, meshes.surfaces, meshes.materials, shadows,
            passes_rough_glass, share,
        )  # fmt: skip
        return share

    def _add_surface_light(
        self,
        paths: PathArrays,
        active: Int32[np.ndarray, " n"],
        shadows: ShadowRayArrays,
        casters: Tracer | None,
    ) -> None:
        """Add the light that reaches surfaces past meshes and the Gaussians of ``casters``."""
        shadows.occluded_radiance_linear[:] = 0.0  # the layers of this bounce wrote to the same rows
        share = self._shadow_transmittance(shadows)
        free = np.flatnonzero(share.any(axis=1))
        if casters is not None and len(free):
            share[free] *= casters.transmittance(_shadow_ray_batch(shadows, free))[:, None]
        self._run_kernel(add_direct_light, len(active), paths, active, shadows.radiance_linear, share)

    def _add_layer_light(
        self,
        paths: PathArrays,
        active: Int32[np.ndarray, " n"],
        shadows: ShadowRayArrays,
        layers: GaussianLayers,
    ) -> None:
        """Add the light that reaches layers of Gaussians, less what meshes shadow."""
        queried = np.flatnonzero(
            shadows.radiance_linear.any(axis=1) | shadows.occluded_radiance_linear.any(axis=1)
        )
        if len(queried) == 0:
            return
        share = self._shadow_transmittance(shadows, passes_rough_glass=True)[queried]
        free, unoccluded = share.any(axis=1), (share == 1.0).all(axis=1)
        through = np.ones((2, len(queried)), np.float32)
        for row, tracer in enumerate((layers.gaussian_shadow_tracer, layers.non_shadow_tracer)):
            # What nobody keeps off needs no tracing where nothing else would count it.
            needed = free if row == 0 else ~unoccluded | (layers.gaussian_shadow_tracer is not None)
            if tracer is not None and needed.any():
                through[row, needed] = tracer.transmittance(
                    _shadow_ray_batch(shadows, queried[needed], layers.shadow_bias)
                )
        light = LayerLight(
            shadows.radiance_linear[queried], shadows.occluded_radiance_linear[queried], share, *through
        )
        self._run_kernel(add_layer_light, len(queried), paths, active[queried], light)

    def _run_kernel(self, kernel: Callable[..., None], rows: int, *arguments: object) -> None:
        """Run a kernel over rows on all threads. Numba's own loops cannot write to named tuples."""
        # few rows are not worth a second thread
        parts = max(1, min(self._threads, rows // MIN_ROWS_PER_THREAD))
        cuts = [rows * part // parts for part in range(parts + 1)]
        work = zip(pairwise(cuts), self._scratches, strict=False)
        if parts == 1:
            kernel(0, rows, self._scratches[0], *arguments)
            return
        tasks = [self._pool.submit(kernel, *cut, scratch, *arguments) for cut, scratch in work]
        for task in tasks:
            task.result()


def _shadow_ray_batch(
    shadows: ShadowRayArrays, rows: Int64[np.ndarray, " n"], t_min: float = 0.0
) -> RayBatch:
    """Return some of the shadow rays as a batch."""
    return RayBatch(shadows.origins_world[rows], shadows.directions_world[rows], t_min, shadows.t_max[rows])
