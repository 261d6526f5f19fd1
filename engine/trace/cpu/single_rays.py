"""Rays that come alone: Embree walks the boxes, numba evaluates the octagons."""

import numpy as np
from jaxtyping import Float32, Int64

from octasplat.engine.compilation import run_on_threads, run_ranges
from octasplat.engine.trace.cpu.bundles import (
    ByGaussian,
    Forward,
    Limits,
    OutputGradients,
    Parameters,
    Rays,
    Scene,
)
from octasplat.engine.trace.cpu.kernels_hit import (
    RAY_WORDS,
    SCRATCH_WORDS,
    absorb_octagon,
    intersect_octagon,
    octagon_bounds,
)
from octasplat.engine.trace.cpu.kernels_single import Embree, absorb_rays, trace_rays
from octasplat.engine.trace.cpu.kernels_single_backward import Shares, gather_gaussians, replay_rays
from octasplat.engine.trace.cpu.kernels_sort import sort_by_gaussian
from octasplat.engine.trace.cpu.memory import aligned_empty, empty_gradients, raw_gradients
from octasplat.engine.trace.cpu.recording import CpuRecording
from octasplat.engine.trace.embree_library import BoxScene, Device, intersect1_address, occluded1_address
from octasplat.engine.trace.protocol import GaussianGradients

MAX_CHUNKS = 1024
"""Each chunk of rays has scratch memory of its own, 1.2 kB, so that any thread may take it."""
MIN_RAYS_PER_CHUNK = 16
SUM_CHUNKS = 16
"""Chunks a thread when hits are summed, of about as many hits each."""
_EVERY_FEATURE = 0xFFFFFFFF


class SingleRayTracer:
    """Follows each ray by itself through an Embree hierarchy of the Gaussians' boxes.

    Args:
        limits: where rays end.
        threads: threads for building and tracing.
        build_quality: Embree's: 0 low, 1 medium, 2 high.
    """

    def __init__(self, limits: Limits, *, threads: int, build_quality: int) -> None:
        self._limits = limits
        self._threads = threads
        self._quality = build_quality
        self._device = Device(threads)
        self._scene: BoxScene | None = None
        self._scratch = aligned_empty((MAX_CHUNKS, -(-SCRATCH_WORDS // 16) * 16))
        # RTCIntersectArguments: flags and feature mask, then the context of each chunk's own scratch row.
        self._arguments = np.zeros((MAX_CHUNKS, 8), np.uint64)
        self._arguments[:, 0] = _EVERY_FEATURE << 32
        self._arguments[:, 1] = self._scratch.ctypes.data + np.arange(MAX_CHUNKS) * self._scratch.strides[0]
        self._arguments[:, 1] += RAY_WORDS * 4

    def build(self, boxes: Float32[np.ndarray, "n 6"]) -> None:
        """Build the hierarchy; ``boxes`` must live as long as it does."""
        self._scene = None  # free the old hierarchy before the new one is made
        self._boxes = boxes
        self._scene = BoxScene(
            self._device,
            len(boxes),
            boxes.ctypes.data,
            octagon_bounds.address,
            intersect_octagon.address,
            absorb_octagon.address,
            quality=self._quality,
        )

    def trace(self, forward: Forward, which: Int64[np.ndarray, " s"]) -> None:
        """Follow the rays ``which``, in ascending order."""
        run_on_threads(
            trace_rays, self._threads,
            self._embree(intersect1_address()), forward, which, _rays_per_chunk(which), np.zeros(1, np.int64),
        )  # fmt: skip

    def absorb(
        self,
        rays: Rays,
        scene: Scene,
        which: Int64[np.ndarray, " s"],
        transmittance: Float32[np.ndarray, " r"],
    ) -> None:
        """Write the transmittance of the rays ``which``."""
        run_on_threads(
            absorb_rays, self._threads,
            self._embree(occluded1_address()), rays, scene, self._limits, which, _rays_per_chunk(which),
            np.zeros(1, np.int64), transmittance,
        )  # fmt: skip

    def backward(
        self, recording: CpuRecording, gradients: OutputGradients, scene: Scene, parameters: Parameters
    ) -> GaussianGradients:
        """Gradients of the raw parameters, hits sorted by Gaussian and summed in ray order."""
        rays, which = Rays.of(recording.rays), recording.alone
        offsets = np.concatenate([[0], np.cumsum(recording.counts[which], dtype=np.int64)])
        total = int(offsets[-1])
        ids, flags = np.empty(total, np.int32), np.empty(total, np.int32)
        shares = Shares(ids, flags, *(np.empty(total, np.float32) for _ in range(3)))
        run_ranges(
            replay_rays, self._threads, len(which),
            rays, which, offsets, recording.hits, recording.counts, scene, self._limits, gradients, shares,
        )  # fmt: skip
        by_gaussian = ByGaussian(*sort_by_gaussian(ids, len(parameters.means), self._threads))
        starts = by_gaussian.starts
        segments = len(starts) - 1
        places = np.linspace(0, total, SUM_CHUNKS * self._threads + 1).astype(np.int64)
        bounds = np.searchsorted(starts, places)
        bounds[0], bounds[-1] = 0, segments
        out = empty_gradients(segments, scene.sh.shape[1], scene.features.shape[1])
        run_on_threads(
            gather_gaussians, self._threads,
            rays, parameters, scene, self._limits, by_gaussian, bounds,
            np.zeros(1, np.int64), shares, gradients, raw_gradients(out),
        )  # fmt: skip
        return out

    def _embree(self, function: int) -> Embree:
        assert self._scene is not None, "build first"
        return Embree(function, self._scene.handle, self._scratch, self._arguments)


def _rays_per_chunk(which: Int64[np.ndarray, " s"]) -> int:
    return max(MIN_RAYS_PER_CHUNK, -(-len(which) // MAX_CHUNKS))
