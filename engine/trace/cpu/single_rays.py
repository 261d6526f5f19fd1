"""Rays that come alone: Embree walks the boxes, numba evaluates the octagons."""

import numpy as np
from jaxtyping import Float32

from engine.gaussians.model import FlatGaussians
from engine.trace.cpu.kernels_hit import RAY_WORDS, SCRATCH_WORDS, intersect_octagon, octagon_bounds
from engine.trace.cpu.kernels_single import trace_rays
from engine.trace.cpu.kernels_single_backward import gather_gaussians, replay_rays
from engine.trace.cpu.kernels_sort import sort_by_gaussian
from engine.trace.cpu.memory import aligned_empty, contiguous, empty_gradients, empty_result, or_zeros
from engine.trace.embree_library import BoxScene, Device, intersect1_address
from engine.trace.protocol import GaussianGradients, HitLists, TraceGradients, TraceResult, TraceSettings

MAX_CHUNKS = 1024
MIN_RAYS_PER_CHUNK = 16
_EVERY_FEATURE = 0xFFFFFFFF


class SingleRayTracer:
    """Follows each ray by itself through an Embree hierarchy of the Gaussians' boxes.

    Args:
        settings: where rays are cut off.
        threads: threads for building and tracing.
        build_quality: Embree's: 0 low, 1 medium, 2 high.
    """

    def __init__(self, settings: TraceSettings, *, threads: int, build_quality: int) -> None:
        self._settings = settings
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
        self._storage = _storage(0)

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
            quality=self._quality,
        )

    def trace(
        self,
        origins: Float32[np.ndarray, "r 3"],
        directions: Float32[np.ndarray, "r 3"],
        records: Float32[np.ndarray, "n 16"],
        gaussians: FlatGaussians,
        features: Float32[np.ndarray, "n f"],
        *,
        record: bool,
    ) -> TraceResult:
        """Follow contiguous rays; the arguments as in :class:`engine.trace.protocol.Tracer`."""
        assert self._scene is not None, "build first"
        count = len(origins)
        settings = self._settings
        rays_per_chunk = max(MIN_RAYS_PER_CHUNK, -(-count // MAX_CHUNKS))
        capacity = -(-count // rays_per_chunk) * rays_per_chunk * settings.max_hits if record else 0
        if len(self._storage[0]) < capacity:
            self._storage = _storage(capacity)
        result = empty_result(count, features.shape[1])
        starts = np.empty(count, np.int64)
        eps2 = settings.second_phase_min
        trace_rays(
            intersect1_address(), self._scene.handle, self._scratch, self._arguments, origins, directions,
            records, gaussians.sh, features,
            settings.transmittance_min, 2.0 if eps2 is None else eps2, settings.t_min, settings.alpha_max,
            settings.max_hits, rays_per_chunk, self._threads, np.zeros(1, np.int64),
            result.rgb_srgb, result.transmittance, result.depth_sum, result.depth_median,
            result.normal_world, result.features, result.hit_counts,
            record, starts, *self._storage,
        )  # fmt: skip
        if record:
            result.hits = HitLists(origins, directions, starts, result.hit_counts, *self._storage)
        return result

    def backward(
        self,
        hits: HitLists,
        gradients: TraceGradients,
        records: Float32[np.ndarray, "n 16"],
        gaussians: FlatGaussians,
        features: Float32[np.ndarray, "n f"],
    ) -> GaussianGradients:
        """Gradients of the raw parameters, hits sorted by Gaussian and summed in ray order."""
        rays = len(hits.counts)
        offsets = np.concatenate([[0], np.cumsum(hits.counts, dtype=np.int64)])
        total = int(offsets[-1])
        keys, flags = np.empty(total, np.int32), np.empty(total, np.int32)
        weights, h_alpha, g_t = (np.empty(total, np.float32) for _ in range(3))
        g = gradients
        g_rgb = contiguous(g.rgb_srgb)
        g_normal = or_zeros(g.normal_world, (rays, 3))
        g_feature = or_zeros(g.features, (rays, features.shape[1]))
        ray_errors = or_zeros(g.ray_errors, (rays,))
        replay_rays(
            hits.directions_world, records, features, hits.starts, hits.counts, offsets,
            hits.ids, hits.alphas, hits.distances, hits.rgb_srgb, self._settings.alpha_max,
            g_rgb, or_zeros(g.transmittance, (rays,)), or_zeros(g.depth_sum, (rays,)),
            or_zeros(g.depth_median, (rays,)), g_normal, g_feature, g.with_geometry,
            keys, flags, weights, h_alpha, g_t,
        )  # fmt: skip
        order, sorted_keys, starts = sort_by_gaussian(keys, len(gaussians), self._threads)
        segments = len(starts) - 1
        # Chunks of about equal numbers of hits.
        bounds = np.searchsorted(starts, np.linspace(0, total, 16 * self._threads + 1).astype(np.int64))
        bounds[0], bounds[-1] = 0, segments
        out = empty_gradients(segments, gaussians.sh.shape[1], features.shape[1])
        gather_gaussians(
            hits.origins_world, hits.directions_world, records,
            gaussians.means_world, gaussians.quats_wxyz, gaussians.log_scales,
            order, sorted_keys, starts, bounds, self._threads, np.zeros(1, np.int64),
            flags, weights, h_alpha, g_t, g_rgb, g_normal, g_feature, ray_errors, g.with_geometry,
            out.ids, out.means_world, out.quats_wxyz, out.log_scales, out.opacity_logits, out.sh,
            out.features, out.weight_sums, out.error_sums, out.hit_counts,
        )  # fmt: skip
        return out


def _storage(capacity: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Ids, alphas, distances and colours; the pages are only taken when a hit is written to them."""
    return (
        np.empty(capacity, np.int32),
        np.empty(capacity, np.float32),
        np.empty(capacity, np.float32),
        np.empty((capacity, 3), np.float32),
    )
