"""The tracer that runs anywhere: Embree walks the boxes, numba evaluates the octagons."""

import numba
import numpy as np
from jaxtyping import Float32, Int32

from engine.gaussians.model import FlatGaussians
from engine.trace.embree_library import BoxScene, Device, intersect1_address
from engine.trace.kernels_backward import gather_gaussians, replay_rays
from engine.trace.kernels_forward import trace_rays
from engine.trace.kernels_hit import RAY_WORDS, RECORD_WORDS, SCRATCH_WORDS, intersect_octagon, octagon_bounds
from engine.trace.kernels_records import refresh_records, write_records
from engine.trace.kernels_sort import sort_by_gaussian
from engine.trace.protocol import (
    GaussianGradients,
    HitLists,
    TraceGradients,
    TraceResult,
    TraceSettings,
)

MAX_CHUNKS = 1024
MIN_RAYS_PER_CHUNK = 16
MAX_RAYS_PER_TRACE = 1 << 28
_EVERY_FEATURE = 0xFFFFFFFF


def aligned_empty(shape: tuple[int, ...]) -> Float32[np.ndarray, "..."]:
    """Uninitialised float32 array whose memory starts on a cache line (64 bytes)."""
    size = int(np.prod(shape)) * 4
    raw = np.empty(size + 64, np.uint8)
    offset = -raw.ctypes.data % 64
    return raw[offset : offset + size].view(np.float32).reshape(shape)


class EmbreeTracer:
    """Flat Gaussians in an Embree hierarchy of their boxes; follows :class:`engine.trace.protocol.Tracer`.

    Hits are exact: a box only says which octagons to test, the octagon test and the distance come from the
    parameters in float64, and hits are ordered by (float32 distance, id). So neither the shape of the
    hierarchy nor the number of threads changes a result, and coplanar Gaussians have one order for all rays.
    Memory per Gaussian: a record of 64 B, a box of 24 B, and Embree's hierarchy over the boxes.

    Not done: no gradient through octagon edges or visibility; rays start outside of no Gaussian (a hit
    counts from ``t_min`` on).

    Args:
        settings: where rays are cut off.
        threads: threads for building and tracing; 0 takes all that numba has.
        box_padding: fraction by which boxes are enlarged, so that parameters may change between builds.
        build_quality: Embree's: 0 low, 1 medium, 2 high.
    """

    def __init__(
        self,
        settings: TraceSettings | None = None,
        *,
        threads: int = 0,
        box_padding: float = 0.0,
        build_quality: int = 1,
    ) -> None:
        self.settings = settings or TraceSettings()
        self.threads = threads or numba.config.NUMBA_NUM_THREADS
        self._padding = box_padding
        self._quality = build_quality
        self._device = Device(self.threads)
        self._scene: BoxScene | None = None
        self._gaussians: FlatGaussians | None = None
        self._features = np.empty((0, 0), np.float32)
        self._records = aligned_empty((0, RECORD_WORDS))
        self._boxes = np.empty((0, 6), np.float32)
        self._scratch = aligned_empty((MAX_CHUNKS, -(-SCRATCH_WORDS // 16) * 16))
        # RTCIntersectArguments: flags and feature mask, then the context of each chunk's own scratch row.
        self._arguments = np.zeros((MAX_CHUNKS, 8), np.uint64)
        self._arguments[:, 0] = _EVERY_FEATURE << 32
        self._arguments[:, 1] = self._scratch.ctypes.data + np.arange(MAX_CHUNKS) * self._scratch.strides[0]
        self._arguments[:, 1] += RAY_WORDS * 4
        self._hit_storage: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] = _hit_storage(0)
        self._recorded: TraceResult | None = None

    def build(self, gaussians: FlatGaussians, features: Float32[np.ndarray, "n f"] | None = None) -> None:
        """Take over ``gaussians`` (kept by reference) and build the hierarchy around them."""
        self._use_threads()
        count = len(gaussians)
        if len(self._records) != count:
            self._records = aligned_empty((count, RECORD_WORDS))
            self._boxes = np.empty((count, 6), np.float32)
        self._gaussians = gaussians
        self._features = np.empty((count, 0), np.float32) if features is None else features
        write_records(self._records, self._boxes, *_parameters(gaussians), self.settings.q, self._padding)
        self._scene = None  # free the old hierarchy before the new one is made
        self._scene = BoxScene(
            self._device,
            count,
            self._boxes.ctypes.data,
            octagon_bounds.address,
            intersect_octagon.address,
            quality=self._quality,
        )

    def refresh(self, ids: Int32[np.ndarray, " u"] | None = None) -> None:
        """Read changed parameters without rebuilding; see the protocol."""
        assert self._gaussians is not None, "build first"
        self._use_threads()
        if ids is None:
            ids = np.arange(len(self._gaussians), dtype=np.int32)
        refresh_records(self._records, ids, *_parameters(self._gaussians), self.settings.q)

    def trace(
        self,
        origins_world: Float32[np.ndarray, "r 3"],
        directions_world: Float32[np.ndarray, "r 3"],
        *,
        record: bool = False,
    ) -> TraceResult:
        """Follow rays; see the protocol. Directions must have unit length."""
        assert self._gaussians is not None and self._scene is not None, "build first"
        self._use_threads()
        count = len(origins_world)
        assert count < MAX_RAYS_PER_TRACE
        settings = self.settings
        origins, directions = _contiguous(origins_world), _contiguous(directions_world)
        rays_per_chunk = max(MIN_RAYS_PER_CHUNK, -(-count // MAX_CHUNKS))
        capacity = -(-count // rays_per_chunk) * rays_per_chunk * settings.max_hits if record else 0
        if len(self._hit_storage[0]) < capacity:
            self._hit_storage = _hit_storage(capacity)
        features = self._features
        result = TraceResult(
            rgb_srgb=np.empty((count, 3), np.float32),
            transmittance=np.empty(count, np.float32),
            depth_sum=np.empty(count, np.float32),
            depth_median=np.empty(count, np.float32),
            normal_world=np.empty((count, 3), np.float32),
            features=np.empty((count, features.shape[1]), np.float32),
            hit_counts=np.empty(count, np.int32),
        )
        starts = np.empty(count, np.int64)
        eps2 = settings.second_phase_min
        trace_rays(
            intersect1_address(), self._scene.handle, self._scratch, self._arguments, origins, directions,
            self._records, self._gaussians.sh, features,
            settings.transmittance_min, 2.0 if eps2 is None else eps2, settings.t_min, settings.alpha_max,
            settings.max_hits, rays_per_chunk, self.threads, np.zeros(1, np.int64),
            result.rgb_srgb, result.transmittance, result.depth_sum, result.depth_median,
            result.normal_world, result.features, result.hit_counts,
            record, starts, *self._hit_storage,
        )  # fmt: skip
        if record:
            result.hits = HitLists(origins, directions, starts, result.hit_counts, *self._hit_storage)
            self._recorded = result
        return result

    def backward(self, hits: HitLists, gradients: TraceGradients) -> GaussianGradients:
        """Gradients of the raw parameters; see the protocol. ``hits`` must be of the last recording trace."""
        result, gaussians = self._recorded, self._gaussians
        assert result is not None and gaussians is not None and result.hits is hits, "hits of an older trace"
        self._use_threads()
        rays = len(hits.counts)
        offsets = np.concatenate([[0], np.cumsum(hits.counts, dtype=np.int64)])
        total = int(offsets[-1])
        keys, flags = np.empty(total, np.int32), np.empty(total, np.int32)
        weights, h_alpha, g_t = (np.empty(total, np.float32) for _ in range(3))
        g = gradients
        with_geometry = any(x is not None for x in (g.depth_sum, g.depth_median, g.normal_world))
        g_rgb = _contiguous(g.rgb_srgb)
        g_normal = _or_zeros(g.normal_world, (rays, 3))
        g_feature = _or_zeros(g.features, (rays, self._features.shape[1]))
        ray_errors = _or_zeros(g.ray_errors, (rays,))
        alpha_max = self.settings.alpha_max
        replay_rays(
            hits.directions_world, self._records, self._features, hits.starts, hits.counts, offsets,
            hits.ids, hits.alphas, hits.distances, hits.rgb_srgb, alpha_max,
            g_rgb, _or_zeros(g.transmittance, (rays,)), _or_zeros(g.depth_sum, (rays,)),
            _or_zeros(g.depth_median, (rays,)), g_normal, g_feature, with_geometry,
            keys, flags, weights, h_alpha, g_t,
        )  # fmt: skip
        order, sorted_keys, starts = sort_by_gaussian(keys, len(gaussians), self.threads)
        segments = len(starts) - 1
        # Chunks of about equal numbers of hits.
        bounds = np.searchsorted(starts, np.linspace(0, total, 16 * self.threads + 1).astype(np.int64))
        bounds[0], bounds[-1] = 0, segments
        out = GaussianGradients(
            ids=np.empty(segments, np.int32),
            means_world=np.empty((segments, 3), np.float32),
            quats_wxyz=np.empty((segments, 4), np.float32),
            log_scales=np.empty((segments, 2), np.float32),
            opacity_logits=np.empty(segments, np.float32),
            sh=np.empty((segments, *gaussians.sh.shape[1:]), np.float32),
            features=np.empty((segments, self._features.shape[1]), np.float32),
            weight_sums=np.empty(segments, np.float32),
            error_sums=np.empty(segments, np.float32),
            hit_counts=np.empty(segments, np.int32),
        )
        gather_gaussians(
            hits.origins_world, hits.directions_world, self._records,
            gaussians.means_world, gaussians.quats_wxyz, gaussians.log_scales,
            order, sorted_keys, starts, bounds, self.threads, np.zeros(1, np.int64),
            flags, weights, h_alpha, g_t, g_rgb, g_normal, g_feature, ray_errors, with_geometry,
            out.ids, out.means_world, out.quats_wxyz, out.log_scales, out.opacity_logits, out.sh,
            out.features, out.weight_sums, out.error_sums, out.hit_counts,
        )  # fmt: skip
        return out

    def _use_threads(self) -> None:
        numba.set_num_threads(min(self.threads, numba.config.NUMBA_NUM_THREADS))


def _parameters(gaussians: FlatGaussians) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    return gaussians.means_world, gaussians.quats_wxyz, gaussians.log_scales, gaussians.opacity_logits


def _hit_storage(capacity: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Ids, alphas, distances and colours; the pages are only taken when a hit is written to them."""
    return (
        np.empty(capacity, np.int32),
        np.empty(capacity, np.float32),
        np.empty(capacity, np.float32),
        np.empty((capacity, 3), np.float32),
    )


def _contiguous(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array, dtype=np.float32)


def _or_zeros(array: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray:
    return np.zeros(shape, np.float32) if array is None else _contiguous(array)
