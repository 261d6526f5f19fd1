"""Packets: neighbouring rays of one origin, such as the pixels of a tile, traced together."""

from typing import Literal

import numpy as np
from jaxtyping import Float32, Int32, Int64

from octasplat.engine.core.compilation import run_on_threads, run_ranges
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.trace.cpu.kernels.kernel_args import (
    BackwardPass,
    ForwardPass,
    GaussianSegments,
    PackedScene,
    PacketHits,
    RayArrays,
    SharedSortHits,
    TraceLimits,
)
from octasplat.engine.trace.cpu.kernels.moment_rows import GEOMETRY_WORDS, ROW_WORDS, MomentRows
from octasplat.engine.trace.cpu.kernels.packet_backward import backward_packets
from octasplat.engine.trace.cpu.kernels.packet_candidates import find_packet_starts
from octasplat.engine.trace.cpu.kernels.packet_forward import trace_packets
from octasplat.engine.trace.cpu.kernels.packet_reduction import reduce_packets, reduce_weights
from octasplat.engine.trace.cpu.kernels.packet_transmittance import packet_transmittance
from octasplat.engine.trace.cpu.kernels.radix_sort import sort_by_gaussian
from octasplat.engine.trace.cpu.kernels.rays import HIT_PADDING
from octasplat.engine.trace.cpu.kernels.shared_sort import trace_packets_shared_sort
from octasplat.engine.trace.cpu.kernels.shared_sort_backward import backward_packets_shared_sort
from octasplat.engine.trace.cpu.kernels.simd16 import PACKET_PRIMITIVE_WORDS
from octasplat.engine.trace.cpu.memory import ArrayPool, empty_gradients, gradient_arrays
from octasplat.engine.trace.cpu.packet_bvh import PacketBvh
from octasplat.engine.trace.cpu.recording import CpuRecording
from octasplat.engine.trace.protocol import GaussianGradients

MAX_RAYS = 64
"""Rays of a packet: their set is the bits of one word."""
MIN_PACKET_COSINE = 0.98
"""A packet's rays look this much (11 degrees) the way its first ray looks, so that its pyramid is narrow."""
MIN_PACKET_RAYS = 3
"""Rays from which a packet is faster than following each alone."""
SINGLE_RAY_RATIO = 8
"""Rays in smaller groups are followed alone if they are one in so many or more; for fewer, building Embree's
hierarchy would cost more than it saves."""
REDUCE_CHUNKS_PER_THREAD = 16
"""Chunks a thread when rows are summed: enough that no thread waits long for another."""

PacketMode = Literal["auto", "always", "never"]


def find_packets(
    rays: RayBatch, mode: PacketMode = "auto", *, needs_color: bool = True
) -> tuple[Int64[np.ndarray, "p 2"], Int64[np.ndarray, " s"]]:
    """Split rays into packets and single rays.

    A group are neighbours in the batch that share an origin, to the bit, and look about one way. Each is
    judged by its own size, but few small ones go as packets, too. A packet sees a Gaussian in one color, so
    that where colors matter the viewers have to stand at the origins. Rays that leave surfaces go alone.

    Args:
        rays: any rays.
        mode: ``auto`` by what is faster; ``always`` (where that is possible) or ``never`` in packets.
        needs_color: whether colors matter.

    Returns:
        First ray of each packet and the one behind its last; and the rays that go alone.
    """
    count = len(rays)
    if (
        mode == "never"
        or count == 0
        or (needs_color and rays.t_view_origin.any())
        or rays.t_backface_cull.any()
    ):
        return np.empty((0, 2), np.int64), np.arange(count)
    starts = np.empty(count + 1, np.int64)
    groups = find_packet_starts(
        rays.origins_world, rays.directions_world, MAX_RAYS, MIN_PACKET_COSINE, starts
    )
    packets = np.stack([starts[:groups], starts[1 : groups + 1]], axis=1)
    sizes = packets[:, 1] - packets[:, 0]
    small = sizes < MIN_PACKET_RAYS
    if mode == "always" or SINGLE_RAY_RATIO * int(sizes[small].sum()) < count:
        return packets, np.empty(0, np.int64)
    return packets[~small], np.flatnonzero(np.repeat(small, sizes))


class PacketTracer:
    """Tracer that traverses the hierarchy once per packet, then tests candidates eight at a time per ray.

    Args:
        limits: where rays end.
        threads: threads for tracing.
        pool: where memory comes from.
    """

    def __init__(self, limits: TraceLimits, *, threads: int, pool: ArrayPool) -> None:
        self._limits = limits
        self._threads = threads
        self._pool = pool
        self._bvh: PacketBvh | None = None
        self._hit_capacity = 0

    def build(self, primitives: Float32[np.ndarray, "n 16"]) -> None:
        """Build the bounding volume hierarchy of the packed Gaussians."""
        self._bvh = PacketBvh(primitives, self._threads)

    def refresh(self, primitives: Float32[np.ndarray, "n 16"], ids: Int32[np.ndarray, " u"]) -> None:
        """Copy changed records, and refit the hierarchy."""
        assert self._bvh is not None, "build first"
        self._bvh.refresh(primitives, ids)

    def allocate_hits(
        self, packets: Int64[np.ndarray, "p 2"], rays: int, *, is_recording: bool
    ) -> PacketHits:
        """Return buffers for the recorded hits of packets."""
        # without a recording nothing is stored
        places = rays * (self._limits.max_hits + HIT_PADDING) if is_recording and len(packets) else 0
        numbers, whole = ((places,), np.float32), ((places,), np.int32)
        us, vs, slots, slot_ids, slot_rgb = self._pool.empty(
            numbers, numbers, whole, whole, ((places, 3), np.float32)
        )
        return PacketHits(us, vs, slots, slot_ids, slot_rgb, slot_counts=np.zeros(len(packets), np.int32))

    def trace(self, forward: ForwardPass, packets: Int64[np.ndarray, "p 2"], packet_hits: PacketHits) -> None:
        """Trace the rays of the packets."""
        assert self._bvh is not None, "build first"
        run_on_threads(
            trace_packets,
            self._threads,
            forward,
            packets,
            self._bvh.arrays,
            packet_hits,
            np.zeros(1, np.int64),
        )

    def trace_shared_sort(
        self, forward: ForwardPass, packets: Int64[np.ndarray, "p 2"], rays: int
    ) -> SharedSortHits:
        """Trace the rays of the packets, all rays of a packet in one depth order.

        How many a packet will meet is not known before, so that what has no room is traced again.
        """
        assert self._bvh is not None, "build first"
        while True:
            places = self._hit_capacity if forward.is_recording else 0
            ids, bits, lines, starts, counts, frames, left = self._pool.empty(
                ((places,), np.int32), ((places,), np.uint64), ((places, PACKET_PRIMITIVE_WORDS), np.float32),
                ((len(packets),), np.int64), ((len(packets),), np.int32), ((len(packets), 9), np.float64),
                ((rays,), np.float32),
            )  # fmt: skip
            packet_hits = SharedSortHits(
                ids=ids,
                ray_masks=bits,
                packet_primitives=lines,
                starts=starts,
                counts=counts,
                frames=frames,
                transmittance=left,
            )
            met = np.zeros(1, np.int64)
            run_on_threads(
                trace_packets_shared_sort, self._threads,
                forward, packets, self._bvh.arrays, packet_hits, np.zeros(1, np.int64), met,
            )  # fmt: skip
            if met[0] <= places or not forward.is_recording:
                left[:] = forward.out.transmittance
                return packet_hits
            self._hit_capacity = int(met[0]) * 5 // 4

    def write_transmittance(
        self,
        rays: RayArrays,
        scene: PackedScene,
        packets: Int64[np.ndarray, "p 2"],
        transmittance: Float32[np.ndarray, " r"],
    ) -> None:
        """Write the transmittance of the rays of the packets."""
        assert self._bvh is not None, "build first"
        run_on_threads(
            packet_transmittance, self._threads,
            rays, scene, self._limits, packets, self._bvh.arrays, np.zeros(1, np.int64), transmittance,
        )  # fmt: skip

    def backward(
        self, recording: CpuRecording, backward: BackwardPass, min_blend_weight: float
    ) -> GaussianGradients:
        """Return gradients of the raw parameters, summed within each packet, then in packet order.

        Gaussians whose weights add up to less than ``min_blend_weight`` are left out before the sums.
        """
        packet_hits, scene = recording.packet_hits, backward.scene
        counts = packet_hits.counts if isinstance(packet_hits, SharedSortHits) else packet_hits.slot_counts
        # rows of packet p begin at firsts[p]: one for each Gaussian that it met
        firsts = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
        count, basis_count, feature_count = int(firsts[-1]), scene.sh.shape[1], scene.features.shape[1]
        geometry = GEOMETRY_WORDS if backward.output_gradients.has_geometry else 0
        ids, weights, sums, geometry_rows, features = self._pool.empty(
            ((count,), np.int32),
            ((count,), np.float32),
            ((count, ROW_WORDS), np.float32),
            ((count, geometry), np.float32),
            ((count, feature_count), np.float32),
        )
        rows = MomentRows(
            firsts=firsts, ids=ids, weights=weights, sums=sums, geometry=geometry_rows, features=features
        )
        packets, counter = recording.packets, np.zeros(1, np.int64)
        if isinstance(packet_hits, SharedSortHits):
            run_on_threads(
                backward_packets_shared_sort,
                self._threads,
                backward,
                packets,
                packet_hits,
                counter,
                rows,
            )
        else:
            run_on_threads(
                backward_packets, self._threads,
                backward, packets, recording.hits, packet_hits, recording.counts, counter, rows,
            )  # fmt: skip
        gaussian_segments = GaussianSegments(
            *sort_by_gaussian(rows.ids, len(backward.parameters.means), self._threads)
        )
        met = np.empty(len(gaussian_segments.starts) - 1, np.float32)
        run_ranges(reduce_weights, self._threads, len(met), gaussian_segments, rows.weights, met)
        # weights alone are summed first: most Gaussians of small weight need no gradient
        which = np.flatnonzero(met >= min_blend_weight)
        out = empty_gradients(len(which), basis_count, feature_count)
        run_on_threads(
            reduce_packets, self._threads,
            backward, packets, gaussian_segments, which, rows,
            REDUCE_CHUNKS_PER_THREAD * self._threads, np.zeros(1, np.int64), gradient_arrays(out),
        )  # fmt: skip
        return out
