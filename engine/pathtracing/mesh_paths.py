"""Paths among meshes alone, each batch on a thread of its own."""

from collections.abc import Sequence
from concurrent.futures import Executor, Future
from queue import Queue

import numpy as np
from jaxtyping import Bool, Float32

from octasplat.engine.pathtracing.compile_meshes import CompiledMeshes
from octasplat.engine.pathtracing.film import Film
from octasplat.engine.pathtracing.kernels.kernel_args import IntegratorParameters
from octasplat.engine.pathtracing.kernels.path_args import GaussianBoxes, PathBlock, PathScratch, PathStart
from octasplat.engine.pathtracing.kernels.trace_paths import trace_paths
from octasplat.engine.pathtracing.path_batches import allocate_path_block, pixels_per_batch

NO_BOXES = GaussianBoxes(np.zeros((6, 0), np.float32), np.zeros((6, 0), np.float32))
INFINITE_T_MAX = np.full(1, np.inf, np.float32)


class MeshPaths:
    """Tracer of the paths that meet meshes alone, and finder of those that may meet Gaussians.

    Args:
        meshes: of the scene.
        boxes: around its Gaussians.
        integrator: how paths go on.
        pool: runs the work.
        scratches: memory of the kernels, for so many batches at a time.
    """

    def __init__(
        self,
        meshes: CompiledMeshes,
        boxes: GaussianBoxes,
        integrator: IntegratorParameters,
        pool: Executor,
        scratches: Sequence[PathScratch],
    ) -> None:
        self._meshes = meshes
        self._boxes = boxes
        self._integrator = integrator
        self._pool = pool
        self._threads = len(scratches)
        self._free: Queue[tuple[PathScratch, PathBlock]] = Queue()
        for scratch in scratches:
            self._free.put((scratch, allocate_path_block()))

    def submit(
        self,
        film: Film,
        start: PathStart,
        t_min: Float32[np.ndarray, "1"],
        enters_box: Bool[np.ndarray, " i"],
    ) -> Future[None]:
        """Let a thread trace the paths of as many pixels as ``enters_box`` has rows, all False before.

        It becomes True for pixels of which a path may meet Gaussians. All others are added to the film. The
        camera sees nothing nearer than ``t_min``.
        """

        def work() -> None:
            scratch, block = self._free.get()
            try:
                trace_paths(
                    len(enters_box), scratch, self._integrator, start, self._meshes.scene,
                    self._meshes.queries, t_min, INFINITE_T_MAX, block, self._boxes,
                    film.sums, film.sums_without_meshes, enters_box,
                )  # fmt: skip
            finally:
                self._free.put((scratch, block))

        return self._pool.submit(work)

    def finish_far_pixels(
        self, film: Film, start: PathStart, t_min: Float32[np.ndarray, "1"], count: int
    ) -> Bool[np.ndarray, " n"]:
        """Finish those of ``count`` pixels of which no path enters a box; return which are left."""
        enters_box = np.zeros(count, np.bool_)
        pixels = pixels_per_batch(count, start.paths_per_pixel, self._threads)
        tasks = [
            self.submit(
                film,
                start._replace(first_pixel=start.first_pixel + top),
                t_min,
                enters_box[top : top + pixels],
            )
            for top in range(0, count, pixels)
        ]
        for task in tasks:
            task.result()
        return enters_box
