"""What a recording trace of the CPU keeps."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int32, Int64

from octasplat.engine.rays import RayBatch
from octasplat.engine.trace.cpu.bundles import Hits, Limits, OneOrderHits, PacketHits
from octasplat.engine.trace.cpu.kernels_rays import first_place


@dataclass(frozen=True)
class CpuRecording:
    """Hits in order along each ray; follows :class:`octasplat.engine.trace.protocol.Recording`.

    Attributes:
        rays: the rays.
        counts: hits on each ray.
        packets: first ray of each packet and the one behind its last.
        alone: the other rays, in ascending order.
        hits: the hits of both.
        kept: what packets keep beside them; of no size where there are none.
        limits: where rays end.
        build: which build of which tracer it belongs to.
    """

    rays: RayBatch
    counts: Int32[np.ndarray, " r"]
    packets: Int64[np.ndarray, "p 2"]
    alone: Int64[np.ndarray, " s"]
    hits: Hits
    kept: PacketHits | OneOrderHits
    limits: Limits
    build: object

    def place(self, ray: int) -> slice:
        """Where the arrays of ``hits`` have those of one ray."""
        start = int(self.hits.starts[ray])
        return slice(start, start + int(self.counts[ray]))

    def of_ray(self, ray: int) -> Int32[np.ndarray, " k"]:
        """Ids of the Gaussians of one ray, front to back."""
        packet = int(np.searchsorted(self.packets[:, 0], ray, side="right")) - 1
        if packet < 0 or ray >= self.packets[packet, 1]:
            return self.hits.ids[self.place(ray)]
        if isinstance(self.kept, OneOrderHits):
            place = slice(*np.cumsum([self.kept.starts[packet], self.kept.counts[packet]]))
            bit = np.uint64(ray - self.packets[packet, 0])
            return self.kept.ids[place][(self.kept.bits[place] >> bit & np.uint64(1)).astype(bool)]
        first = first_place.py_func(int(self.packets[packet, 0]), self.limits)
        return self.kept.slot_ids[first + self.kept.slots[self.place(ray)]]

    def by_ray(self) -> tuple[Int32[np.ndarray, " r"], Int32[np.ndarray, " h"]]:
        """Hits of each ray, and the ids of all hits, ray by ray and front to back."""
        if isinstance(self.kept, OneOrderHits):
            rows = [self.of_ray(ray) for ray in range(len(self.counts))]
            return self.counts, np.concatenate([np.empty(0, np.int32), *rows])
        firsts = np.cumsum(self.counts, dtype=np.int64) - self.counts
        places = np.arange(int(self.counts.sum())) + np.repeat(self.hits.starts - firsts, self.counts)
        leads = np.full(len(self.counts), -1, np.int64)  # first ray of each ray's packet
        for first, last in self.packets.tolist():
            leads[first:last] = first
        lead = np.repeat(leads, self.counts)
        ids = np.empty(len(places), np.int32)
        alone = lead < 0
        ids[alone] = self.hits.ids[places[alone]]
        slots = first_place.py_func(lead[~alone], self.limits) + self.kept.slots[places[~alone]]
        ids[~alone] = self.kept.slot_ids[slots]
        return self.counts, ids
