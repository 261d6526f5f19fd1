"""Rays that come in packets: neighbours with one origin, such as the pixels of a tile."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32, Int64

from engine.gaussians.model import FlatGaussians
from engine.trace.cpu.kernels_packet import packet_starts
from engine.trace.cpu.kernels_packet_backward import ROW_WORDS, replay_packets, sum_packets
from engine.trace.cpu.kernels_packet_forward import trace_packets
from engine.trace.cpu.kernels_sort import sort_by_gaussian
from engine.trace.cpu.memory import Scratch, contiguous, empty_gradients, empty_result, or_zeros
from engine.trace.cpu.packet_tree import PacketTree
from engine.trace.protocol import GaussianGradients, HitLists, TraceGradients, TraceResult, TraceSettings

MAX_RAYS = 64
"""Rays of a packet: their set is the bits of one word."""
SUM_CHUNKS = 16
LEAST_COSINE = 0.98
"""A packet's rays look this much the way its first ray looks, so that its pyramid is narrow."""


@dataclass
class PacketHits(HitLists):
    """Hits of packets. ``slots`` numbers the Gaussians of each packet in the order in which it met them.

    ``us`` and ``vs`` are the hits in standard deviations; the Gaussian in slot s of the packet that begins
    with ray f is ``slot_ids[f * max_hits + s]``.
    """

    packets: Int64[np.ndarray, " p1"]
    us: Float32[np.ndarray, " h"]
    vs: Float32[np.ndarray, " h"]
    slots: Int32[np.ndarray, " h"]
    slot_ids: Int32[np.ndarray, " h"]
    slot_counts: Int32[np.ndarray, " p"]


def find_packets(
    origins_world: Float32[np.ndarray, "r 3"], directions_world: Float32[np.ndarray, "r 3"]
) -> Int64[np.ndarray, " p1"]:
    """First ray of each packet, and the number of rays: neighbours in the arrays that share an origin."""
    starts = np.empty(len(origins_world) + 1, np.int64)
    count = packet_starts(origins_world, directions_world, MAX_RAYS, LEAST_COSINE, starts)
    return starts[: count + 1]


class PacketTracer:
    """Walks the hierarchy once a packet, then tests its candidates eight at a time against each ray.

    Args:
        settings: where rays are cut off.
        threads: threads for tracing.
    """

    def __init__(self, settings: TraceSettings, *, threads: int) -> None:
        self._settings = settings
        self._threads = threads
        self._tree: PacketTree | None = None
        self._storage = _storage(0)
        self._scratch = Scratch()

    def build(self, records: Float32[np.ndarray, "n 16"], padding: float) -> None:
        """Build the hierarchy."""
        self._tree = PacketTree(records, padding)

    def refresh(self, records: Float32[np.ndarray, "n 16"], ids: Int32[np.ndarray, " u"]) -> None:
        """Take changed records over."""
        assert self._tree is not None, "build first"
        self._tree.refresh(records, ids)

    def trace(
        self,
        origins: Float32[np.ndarray, "r 3"],
        directions: Float32[np.ndarray, "r 3"],
        packets: Int64[np.ndarray, " p1"],
        records: Float32[np.ndarray, "n 16"],
        gaussians: FlatGaussians,
        features: Float32[np.ndarray, "n f"],
        *,
        record: bool,
    ) -> TraceResult:
        """Follow contiguous rays in packets; the arguments as in :class:`engine.trace.protocol.Tracer`."""
        tree = self._tree
        assert tree is not None, "build first"
        count = len(origins)
        settings = self._settings
        capacity = count * settings.max_hits if record else 0
        if len(self._storage[0]) < capacity:
            self._storage = _storage(capacity)
        ids, alphas, distances, rgb, us, vs, slots, slot_ids = self._storage
        result = empty_result(count, features.shape[1])
        starts = np.empty(count, np.int64)
        slot_counts = np.zeros(len(packets) - 1, np.int32)
        eps2 = settings.second_phase_min
        trace_packets(
            origins, directions, packets, tree.nodes, tree.level_starts, tree.blocks, tree.order,
            records, gaussians.sh, features,
            settings.transmittance_min, 2.0 if eps2 is None else eps2, settings.t_min, settings.alpha_max,
            settings.max_hits, self._threads, np.zeros(1, np.int64),
            result.rgb_srgb, result.transmittance, result.depth_sum, result.depth_median,
            result.normal_world, result.features, result.hit_counts,
            record, starts, ids, alphas, distances, rgb, us, vs, slots, slot_ids, slot_counts,
        )  # fmt: skip
        if record:
            result.hits = PacketHits(
                origins, directions, starts, result.hit_counts, ids, alphas, distances, rgb,
                packets, us, vs, slots, slot_ids, slot_counts,
            )  # fmt: skip
        return result

    def backward(
        self,
        hits: PacketHits,
        gradients: TraceGradients,
        records: Float32[np.ndarray, "n 16"],
        gaussians: FlatGaussians,
        features: Float32[np.ndarray, "n f"],
    ) -> GaussianGradients:
        """Gradients of the raw parameters: summed within each packet, then over packets in their order."""
        g, rays = gradients, len(hits.counts)
        basis_count, feature_count = gaussians.sh.shape[1], features.shape[1]
        first_rows = np.concatenate([[0], np.cumsum(hits.slot_counts, dtype=np.int64)])
        rows = int(first_rows[-1])
        row_ids = self._scratch.take("ids", (rows,), np.int32)
        row_sums = self._scratch.take("sums", (rows, ROW_WORDS), np.float32)
        row_sh = self._scratch.take("sh", (rows, basis_count, 3), np.float32)
        row_features = np.empty((rows, feature_count), np.float32)
        replay_packets(
            hits.origins_world, hits.directions_world, hits.packets,
            gaussians.means_world, gaussians.quats_wxyz, gaussians.log_scales, features,
            hits.starts, hits.counts, hits.alphas, hits.distances, hits.rgb_srgb, hits.us, hits.vs,
            hits.slots, hits.slot_ids, hits.slot_counts, first_rows,
            self._settings.max_hits, self._settings.alpha_max,
            contiguous(g.rgb_srgb), or_zeros(g.transmittance, (rays,)), or_zeros(g.depth_sum, (rays,)),
            or_zeros(g.depth_median, (rays,)), or_zeros(g.normal_world, (rays, 3)),
            or_zeros(g.features, (rays, feature_count)), or_zeros(g.ray_errors, (rays,)),
            g.with_geometry, self._threads, np.zeros(1, np.int64),
            row_ids, row_sums, row_sh, row_features,
        )  # fmt: skip
        order, sorted_ids, starts = sort_by_gaussian(row_ids, len(gaussians), self._threads)
        out = empty_gradients(len(starts) - 1, basis_count, feature_count)
        sum_packets(
            gaussians.quats_wxyz, gaussians.log_scales, records,
            order, sorted_ids, starts, SUM_CHUNKS * self._threads, row_sums, row_sh, row_features,
            out.ids, out.means_world, out.quats_wxyz, out.log_scales, out.opacity_logits, out.sh,
            out.features, out.weight_sums, out.error_sums, out.hit_counts,
        )  # fmt: skip
        return out


def _storage(capacity: int) -> tuple[np.ndarray, ...]:
    """Of each hit: id, alpha, distance, colour, u, v, slot; and the slots' ids.

    The pages are only taken when a hit is written to them.
    """
    return (
        np.empty(capacity, np.int32),
        np.empty(capacity, np.float32),
        np.empty(capacity, np.float32),
        np.empty((capacity, 3), np.float32),
        np.empty(capacity, np.float32),
        np.empty(capacity, np.float32),
        np.empty(capacity, np.int32),
        np.empty(capacity, np.int32),
    )
