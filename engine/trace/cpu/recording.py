"""Recorded hits of the CPU tracer."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32, Int64

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.trace.cpu.kernels.kernel_args import HitArrays, PacketHits, SharedSortHits, TraceLimits
from octasplat.engine.trace.cpu.kernels.rays import first_hit_index


@dataclass(frozen=True)
class CpuRecording:
    """Hits in order along each ray; follows :class:`octasplat.engine.trace.protocol.Recording`.

    Attributes:
        rays: the rays.
        counts: hits on each ray.
        packets: first ray of each packet and the one behind its last.
        single_rays: the other rays, in ascending order.
        hits: the hits of both.
        packet_hits: what packets keep beside them; of no size where there are none.
        limits: where rays end.
        build_id: which build of which tracer it belongs to.
    """

    rays: RayBatch
    counts: Int32[np.ndarray, " r"]
    packets: Int64[np.ndarray, "p 2"]
    single_rays: Int64[np.ndarray, " s"]
    hits: HitArrays
    packet_hits: PacketHits | SharedSortHits
    limits: TraceLimits
    build_id: object

    def hit_slice(self, ray: int) -> slice:
        """Return the slice of one ray in the arrays of ``hits``."""
        start = int(self.hits.starts[ray])
        return slice(start, start + int(self.counts[ray]))

    def ids_of_ray(self, ray: int) -> Int32[np.ndarray, " k"]:
        """Return the ids of one ray's Gaussians, front to back."""
        packet = int(np.searchsorted(self.packets[:, 0], ray, side="right")) - 1  # packets ascend
        if packet < 0 or ray >= self.packets[packet, 1]:
            return self.hits.ids[self.hit_slice(ray)]
        if isinstance(self.packet_hits, SharedSortHits):
            place = slice(*np.cumsum([self.packet_hits.starts[packet], self.packet_hits.counts[packet]]))
            bit = np.uint64(ray - self.packets[packet, 0])
            return self.packet_hits.ids[place][
                (self.packet_hits.ray_masks[place] >> bit & np.uint64(1)).astype(bool)
            ]
        # the kernels' formula, not compiled for these types
        first = first_hit_index.py_func(int(self.packets[packet, 0]), self.limits)
        return self.packet_hits.slot_ids[first + self.packet_hits.slots[self.hit_slice(ray)]]

    def ids_by_ray(self) -> tuple[Int32[np.ndarray, " r"], Int32[np.ndarray, " h"]]:
        """Return the hit count of each ray, and the ids of all hits, ray by ray and front to back."""
        if isinstance(self.packet_hits, SharedSortHits):
            rows = [self.ids_of_ray(ray) for ray in range(len(self.counts))]
            return self.counts, np.concatenate([np.empty(0, np.int32), *rows])
        places = self._hit_places()
        leads = np.full(len(self.counts), -1, np.int64)  # first ray of each ray's packet
        for first, last in self.packets.tolist():
            leads[first:last] = first
        lead = np.repeat(leads, self.counts)
        ids = np.empty(len(places), np.int32)
        alone = lead < 0
        ids[alone] = self.hits.ids[places[alone]]
        slots = first_hit_index.py_func(lead[~alone], self.limits) + self.packet_hits.slots[places[~alone]]
        ids[~alone] = self.packet_hits.slot_ids[slots]
        return self.counts, ids

    def alphas_by_ray(self) -> Float32[np.ndarray, " h"] | None:
        """Return the opacities at all hits, in the order of the ids; None where packets share one order."""
        return None if isinstance(self.packet_hits, SharedSortHits) else self.hits.alphas[self._hit_places()]

    def _hit_places(self) -> Int64[np.ndarray, " h"]:
        """Return where the hits of all rays are in the arrays of ``hits``, ray by ray."""
        firsts = np.cumsum(self.counts, dtype=np.int64) - self.counts
        return np.arange(int(self.counts.sum())) + np.repeat(self.hits.starts - firsts, self.counts)
