"""Single rays: Embree traverses the boxes, numba kernels evaluate the octagons."""

import numpy as np
from jaxtyping import Float32, Int64

from octasplat.engine.core.compilation import run_on_threads, run_ranges
from octasplat.engine.trace.cpu.kernels.kernel_args import (
    BackwardPass,
    ForwardPass,
    GaussianSegments,
    PackedScene,
    RayArrays,
    TraceLimits,
)
from octasplat.engine.trace.cpu.kernels.octagon_hit import (
    RAY_WORDS,
    SCRATCH_WORDS,
    attenuate_by_octagon,
    intersect_octagon,
    octagon_bounds,
)
from octasplat.engine.trace.cpu.kernels.radix_sort import sort_by_gaussian
from octasplat.engine.trace.cpu.kernels.single_backward import HitGradients, backward_rays, reduce_hits
from octasplat.engine.trace.cpu.kernels.single_forward import (
    EmbreeRayQuery,
    trace_rays,
    write_ray_transmittance,
)
from octasplat.engine.trace.cpu.memory import aligned_empty, empty_gradients, gradient_arrays
from octasplat.engine.trace.cpu.recording import CpuRecording
from octasplat.engine.trace.embree import EmbreeBoxScene, EmbreeDevice, intersect1_address, occluded1_address
from octasplat.engine.trace.protocol import GaussianGradients

MAX_CHUNKS = 1024
"""Each chunk of rays has scratch memory of its own, 1.2 kB, so that any thread may take it."""
MIN_RAYS_PER_CHUNK = 16
REDUCE_CHUNKS_PER_THREAD = 16
"""Chunks a thread when hits are summed, of about as many hits each."""
_RTC_FEATURE_FLAG_ALL = 0xFFFFFFFF


class SingleRayTracer:
    """Tracer of individual rays through an Embree hierarchy of the Gaussians' boxes.

    Args:
        limits: where rays end.
        threads: threads for building and tracing.
        build_quality: Embree's: 0 low, 1 medium, 2 high.
    """

    def __init__(self, limits: TraceLimits, *, threads: int, build_quality: int) -> None:
        self._limits = limits
        self._threads = threads
        self._quality = build_quality
        self._device = EmbreeDevice(threads)
        self._bvh: EmbreeBoxScene | None = None
        # rows of whole cache lines, so that threads do not write to the same one
        self._scratch = aligned_empty((MAX_CHUNKS, -(-SCRATCH_WORDS // 16) * 16))
        # RTCIntersectArguments: flags and feature mask, then the context of each chunk's own scratch row.
        self._arguments = np.zeros((MAX_CHUNKS, 8), np.uint64)
        self._arguments[:, 0] = _RTC_FEATURE_FLAG_ALL << 32
        self._arguments[:, 1] = self._scratch.ctypes.data + np.arange(MAX_CHUNKS) * self._scratch.strides[0]
        self._arguments[:, 1] += RAY_WORDS * 4

    def build(self, boxes: Float32[np.ndarray, "n 6"]) -> None:
        """Build the hierarchy; ``boxes`` must live as long as it does."""
        self._bvh = None  # free the old hierarchy before the new one is made
        self._boxes = boxes
        self._bvh = EmbreeBoxScene(
            device=self._device,
            count=len(boxes),
            boxes_address=boxes.ctypes.data,
            bounds_callback=octagon_bounds.address,
            intersect_callback=intersect_octagon.address,
            occluded_callback=attenuate_by_octagon.address,
            quality=self._quality,
        )

    def trace(self, forward: ForwardPass, ray_indices: Int64[np.ndarray, " s"]) -> None:
        """Trace the rays ``ray_indices``, in ascending order."""
        run_on_threads(
            trace_rays, self._threads,
            self._ray_query(intersect1_address()), forward, ray_indices, _rays_per_chunk(ray_indices),
            np.zeros(1, np.int64),
        )  # fmt: skip

    def write_transmittance(
        self,
        rays: RayArrays,
        scene: PackedScene,
        ray_indices: Int64[np.ndarray, " s"],
        transmittance: Float32[np.ndarray, " r"],
    ) -> None:
        """Write the transmittance of the rays ``ray_indices``."""
        run_on_threads(
            write_ray_transmittance, self._threads,
            self._ray_query(occluded1_address()), rays, scene, self._limits, ray_indices,
            _rays_per_chunk(ray_indices), np.zeros(1, np.int64), transmittance,
        )  # fmt: skip

    def backward(self, recording: CpuRecording, backward: BackwardPass) -> GaussianGradients:
        """Return gradients of the raw parameters, hits sorted by Gaussian and summed in ray order."""
        which, scene = recording.single_rays, backward.scene
        offsets = np.concatenate([[0], np.cumsum(recording.counts[which], dtype=np.int64)])
        total = int(offsets[-1])
        ids, flags = np.empty(total, np.int32), np.empty(total, np.int32)
        shares = HitGradients(ids, flags, *(np.empty(total, np.float32) for _ in range(3)))
        run_ranges(
            backward_rays, self._threads, len(which),
            which, offsets, backward, recording.hits, recording.counts, shares,
        )  # fmt: skip
        gaussian_segments = GaussianSegments(
            *sort_by_gaussian(ids, len(backward.parameters.means), self._threads)
        )
        starts = gaussian_segments.starts
        segments = len(starts) - 1
        # about as many hits a chunk, cut where the next Gaussian begins
        places = np.linspace(0, total, REDUCE_CHUNKS_PER_THREAD * self._threads + 1).astype(np.int64)
        bounds = np.searchsorted(starts, places)
        bounds[0], bounds[-1] = 0, segments
        out = empty_gradients(segments, scene.sh.shape[1], scene.features.shape[1])
        run_on_threads(
            reduce_hits, self._threads,
            backward, gaussian_segments, bounds, np.zeros(1, np.int64), shares, gradient_arrays(out),
        )  # fmt: skip
        return out

    def _ray_query(self, function: int) -> EmbreeRayQuery:
        assert self._bvh is not None, "build first"
        words = self._scratch
        return EmbreeRayQuery(
            function, self._bvh.handle, words,
            words.view(np.int32), words.view(np.float64), words.view(np.uint64), self._arguments,
        )  # fmt: skip


def _rays_per_chunk(ray_indices: Int64[np.ndarray, " s"]) -> int:
    return max(MIN_RAYS_PER_CHUNK, -(-len(ray_indices) // MAX_CHUNKS))
