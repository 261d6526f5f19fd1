"""Rays that come in packets: neighbours with one origin, such as the pixels of a tile."""

from typing import Literal

import numpy as np
from jaxtyping import Float32, Int32, Int64

from octasplat.engine.compilation import run_on_threads, run_ranges
from octasplat.engine.rays import RayBatch
from octasplat.engine.trace.cpu.bundles import (
    ByGaussian,
    Forward,
    Limits,
    OneOrderHits,
    OutputGradients,
    PacketHits,
    Parameters,
    Rays,
    Scene,
)
from octasplat.engine.trace.cpu.kernels_one_order import see_packets
from octasplat.engine.trace.cpu.kernels_one_order_backward import replay_one_order
from octasplat.engine.trace.cpu.kernels_packet import packet_starts
from octasplat.engine.trace.cpu.kernels_packet_backward import (
    GEOMETRY_WORDS,
    ROW_WORDS,
    Rows,
    replay_packets,
    sum_packets,
    sum_weights,
)
from octasplat.engine.trace.cpu.kernels_packet_forward import absorb_packets, trace_packets
from octasplat.engine.trace.cpu.kernels_rays import SPARE
from octasplat.engine.trace.cpu.kernels_sixteen import LINE
from octasplat.engine.trace.cpu.kernels_sort import sort_by_gaussian
from octasplat.engine.trace.cpu.memory import Pool, empty_gradients, raw_gradients
from octasplat.engine.trace.cpu.packet_tree import PacketTree
from octasplat.engine.trace.cpu.recording import CpuRecording
from octasplat.engine.trace.protocol import GaussianGradients

MAX_RAYS = 64
"""Rays of a packet: their set is the bits of one word."""
LEAST_COSINE = 0.98
"""A packet's rays look this much (11 degrees) the way its first ray looks, so that its pyramid is narrow."""
WORTH_A_PACKET = 3
"""Rays from which a packet is faster than following each alone."""
WORTH_A_HIERARCHY = 8
"""Rays in smaller groups are followed alone if they are one in so many or more; for fewer, building Embree's
hierarchy would cost more than it saves."""
SUM_CHUNKS = 16
"""Chunks a thread when rows are summed: enough that no thread waits long for another."""

Ways = Literal["auto", "always", "never"]


def find_packets(
    rays: RayBatch, ways: Ways = "auto", *, coloured: bool = True
) -> tuple[Int64[np.ndarray, "p 2"], Int64[np.ndarray, " s"]]:
    """Which rays go in packets, and which alone.

    A group are neighbours in the batch that share an origin, to the bit, and look about one way. Each is
    judged by its own size, but few small ones go as packets, too. A packet sees a Gaussian in one colour, so
    that where colours matter the viewers have to stand at the origins. Rays that leave surfaces go alone.

    Args:
        rays: any rays.
        ways: ``auto`` by what is faster; ``always`` (where that is possible) or ``never`` in packets.
        coloured: whether colours matter.

    Returns:
        First ray of each packet and the one behind its last; and the rays that go alone.
    """
    count = len(rays)
    if ways == "never" or count == 0 or (coloured and rays.t_viewer.any()) or rays.t_leaves.any():
        return np.empty((0, 2), np.int64), np.arange(count)
    starts = np.empty(count + 1, np.int64)
    groups = packet_starts(rays.origins_world, rays.directions_world, MAX_RAYS, LEAST_COSINE, starts)
    packets = np.stack([starts[:groups], starts[1 : groups + 1]], axis=1)
    sizes = packets[:, 1] - packets[:, 0]
    small = sizes < WORTH_A_PACKET
    if ways == "always" or WORTH_A_HIERARCHY * int(sizes[small].sum()) < count:
        return packets, np.empty(0, np.int64)
    return packets[~small], np.flatnonzero(np.repeat(small, sizes))


class PacketTracer:
    """Walks the hierarchy once a packet, then tests its candidates eight at a time against each ray.

    Args:
        limits: where rays end.
        threads: threads for tracing.
        pool: where memory comes from.
    """

    def __init__(self, limits: Limits, *, threads: int, pool: Pool) -> None:
        self._limits = limits
        self._threads = threads
        self._pool = pool
        self._tree: PacketTree | None = None
        self._most_met = 0

    def build(self, records: Float32[np.ndarray, "n 16"]) -> None:
        """Build the hierarchy."""
        self._tree = PacketTree(records, self._threads)

    def refresh(self, records: Float32[np.ndarray, "n 16"], ids: Int32[np.ndarray, " u"]) -> None:
        """Take changed records over, and refit the hierarchy."""
        assert self._tree is not None, "build first"
        self._tree.refresh(records, ids)

    def room(self, packets: Int64[np.ndarray, "p 2"], rays: int, *, recording: bool) -> PacketHits:
        """Memory for what packets keep of their hits."""
        places = rays * (self._limits.max_hits + SPARE) if recording and len(packets) else 0
        numbers, whole = ((places,), np.float32), ((places,), np.int32)
        us, vs, slots, slot_ids, slot_rgb = self._pool.empty(
            numbers, numbers, whole, whole, ((places, 3), np.float32)
        )
        return PacketHits(us, vs, slots, slot_ids, slot_rgb, slot_counts=np.zeros(len(packets), np.int32))

    def trace(self, forward: Forward, packets: Int64[np.ndarray, "p 2"], kept: PacketHits) -> None:
        """Follow the rays of the packets."""
        assert self._tree is not None, "build first"
        run_on_threads(
            trace_packets, self._threads, forward, packets, self._tree.arrays, kept, np.zeros(1, np.int64)
        )

    def trace_in_one_order(
        self, forward: Forward, packets: Int64[np.ndarray, "p 2"], rays: int
    ) -> OneOrderHits:
        """Follow the rays of the packets, those of a packet through its Gaussians in one order.

        How many a packet will meet is not known before, so that what has no room is traced again.
        """
        assert self._tree is not None, "build first"
        while True:
            places = self._most_met if forward.recording else 0
            ids, bits, lines, starts, counts, frames, left = self._pool.empty(
                ((places,), np.int32), ((places,), np.uint64), ((places, LINE), np.float32),
                ((len(packets),), np.int64), ((len(packets),), np.int32), ((len(packets), 9), np.float64),
                ((rays,), np.float32),
            )  # fmt: skip
            kept = OneOrderHits(ids, bits, lines, starts, counts, frames, left)
            met = np.zeros(1, np.int64)
            run_on_threads(
                see_packets, self._threads,
                forward, packets, self._tree.arrays, kept, np.zeros(1, np.int64), met,
            )  # fmt: skip
            if met[0] <= places or not forward.recording:
                left[:] = forward.out.transmittance
                return kept
            self._most_met = int(met[0]) * 5 // 4

    def absorb(
        self,
        rays: Rays,
        scene: Scene,
        packets: Int64[np.ndarray, "p 2"],
        transmittance: Float32[np.ndarray, " r"],
    ) -> None:
        """Write the transmittance of the rays of the packets."""
        assert self._tree is not None, "build first"
        run_on_threads(
            absorb_packets, self._threads,
            rays, scene, self._limits, packets, self._tree.arrays, np.zeros(1, np.int64), transmittance,
        )  # fmt: skip

    def backward(
        self,
        recording: CpuRecording,
        gradients: OutputGradients,
        scene: Scene,
        parameters: Parameters,
        least_weight: float,
    ) -> GaussianGradients:
        """Gradients of the raw parameters: summed within each packet, then over packets in their order.

        Gaussians whose weights add up to less than ``least_weight`` are left out before the sums.
        """
        kept = recording.kept
        counts = kept.counts if isinstance(kept, OneOrderHits) else kept.slot_counts
        firsts = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
        count, basis_count, feature_count = int(firsts[-1]), scene.sh.shape[1], scene.features.shape[1]
        geometry = GEOMETRY_WORDS if gradients.with_geometry else 0
        ids, weights, sums, by_geometry, features = self._pool.empty(
            ((count,), np.int32),
            ((count,), np.float32),
            ((count, ROW_WORDS), np.float32),
            ((count, geometry), np.float32),
            ((count, feature_count), np.float32),
        )
        rows = Rows(firsts, ids, weights, sums, by_geometry, features)
        rays, packets, counter = Rays.of(recording.rays), recording.packets, np.zeros(1, np.int64)
        if isinstance(kept, OneOrderHits):
            run_on_threads(
                replay_one_order, self._threads, rays, packets, kept, self._limits, gradients, counter, rows
            )
        else:
            run_on_threads(
                replay_packets, self._threads,
                rays, packets, recording.hits, kept, recording.counts, parameters, scene.features,
                self._limits, gradients, counter, rows,
            )  # fmt: skip
        by_gaussian = ByGaussian(*sort_by_gaussian(rows.ids, len(parameters.means), self._threads))
        met = np.empty(len(by_gaussian.starts) - 1, np.float32)
        run_ranges(sum_weights, self._threads, len(met), by_gaussian, rows.weights, met)
        which = np.flatnonzero(met >= least_weight)
        out = empty_gradients(len(which), basis_count, feature_count)
        run_on_threads(
            sum_packets, self._threads,
            rays, packets, parameters, scene, self._limits, by_gaussian, which, rows,
            SUM_CHUNKS * self._threads, np.zeros(1, np.int64), raw_gradients(out),
        )  # fmt: skip
        return out
