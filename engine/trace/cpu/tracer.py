"""The tracer that runs on any CPU: packets of neighbouring rays, and Embree for rays that come alone."""

from typing import Literal

import numba
import numpy as np
from jaxtyping import Float32, Int32

from engine.gaussians.model import FlatGaussians
from engine.threads import use_threads
from engine.trace.cpu.kernels_hit import RECORD_WORDS
from engine.trace.cpu.kernels_records import refresh_records, write_boxes, write_records
from engine.trace.cpu.memory import aligned_empty, contiguous
from engine.trace.cpu.packets import PacketHits, PacketTracer, find_packets
from engine.trace.cpu.single_rays import SingleRayTracer
from engine.trace.protocol import GaussianGradients, HitLists, TraceGradients, TraceResult, TraceSettings

MAX_RAYS_PER_TRACE = 1 << 28
WORTH_A_PACKET = 3.0
"""Mean rays a packet from which packets are faster."""


class CpuTracer:
    """Flat Gaussians for a CPU; follows :class:`engine.trace.protocol.Tracer`.

    Rays that lie beside each other in the arrays, share their origin and look about one way form packets.
    Where the packets are too small on average, every ray is followed alone.

    Hits are exact: a hierarchy only says which octagons to test, the octagon test and the distance come
    from the parameters in float64, and hits are ordered by (float32 distance, id). So neither the shape of
    a hierarchy nor the number of threads changes a result; packets and single rays agree to the last digits
    of float64. Memory per Gaussian: a record of 64 B, 48 B of the packets' hierarchy and a box of 24 B;
    Embree's hierarchy over the boxes is built when the first single rays want it.

    Not done: no gradient through octagon edges or visibility; rays start outside of no Gaussian (a hit
    counts from ``t_min`` on).

    Args:
        settings: where rays are cut off.
        threads: threads for building and tracing; 0 takes all that numba has.
        box_padding: fraction by which boxes are enlarged, so that parameters may change between builds.
        build_quality: Embree's: 0 low, 1 medium, 2 high.
        packets: whether rays go in packets: "auto" decides by what is faster.
    """

    def __init__(
        self,
        settings: TraceSettings | None = None,
        *,
        threads: int = 0,
        box_padding: float = 0.0,
        build_quality: int = 1,
        packets: Literal["auto", "always", "never"] = "auto",
    ) -> None:
        self.settings = settings or TraceSettings()
        self.threads = threads or numba.config.NUMBA_NUM_THREADS
        self._padding = box_padding
        self._singles = SingleRayTracer(self.settings, threads=self.threads, build_quality=build_quality)
        self._least_rays = {"auto": WORTH_A_PACKET, "always": 0.0, "never": np.inf}[packets]
        self._packets = PacketTracer(self.settings, threads=self.threads)
        self._built_singles = False
        self._gaussians: FlatGaussians | None = None
        self._features = np.empty((0, 0), np.float32)
        self._records = aligned_empty((0, RECORD_WORDS))
        self._boxes = np.empty((0, 6), np.float32)
        self._recorded: HitLists | None = None

    def build(self, gaussians: FlatGaussians, features: Float32[np.ndarray, "n f"] | None = None) -> None:
        """Take over ``gaussians`` (kept by reference) and build the hierarchy around them."""
        use_threads(self.threads)
        count = len(gaussians)
        if len(self._records) != count:
            self._records = aligned_empty((count, RECORD_WORDS))
            self._boxes = np.empty((count, 6), np.float32)
        self._gaussians = gaussians
        self._features = np.empty((count, 0), np.float32) if features is None else features
        write_records(self._records, *_parameters(gaussians), self.settings.q)
        # Boxes are those of this moment, whenever single rays come: what was traced before must not matter.
        write_boxes(self._boxes, *_parameters(gaussians), self.settings.q, self._padding)
        self._packets.build(self._records, self._padding)
        self._built_singles = False

    def refresh(self, ids: Int32[np.ndarray, " u"] | None = None) -> None:
        """Read changed parameters without rebuilding; see the protocol."""
        assert self._gaussians is not None, "build first"
        use_threads(self.threads)
        if ids is None:
            ids = np.arange(len(self._gaussians), dtype=np.int32)
        refresh_records(self._records, ids, *_parameters(self._gaussians), self.settings.q)
        self._packets.refresh(self._records, ids)

    def trace(
        self,
        origins_world: Float32[np.ndarray, "r 3"],
        directions_world: Float32[np.ndarray, "r 3"],
        *,
        record: bool = False,
    ) -> TraceResult:
        """Follow rays; see the protocol. Directions must have unit length."""
        assert self._gaussians is not None, "build first"
        use_threads(self.threads)
        count = len(origins_world)
        assert count < MAX_RAYS_PER_TRACE
        origins, directions = contiguous(origins_world), contiguous(directions_world)
        packets = find_packets(origins, directions)
        if count >= self._least_rays * (len(packets) - 1):
            result = self._packets.trace(
                origins, directions, packets, self._records, self._gaussians, self._features, record=record
            )
        else:
            if not self._built_singles:
                self._singles.build(self._boxes)
                self._built_singles = True
            result = self._singles.trace(
                origins, directions, self._records, self._gaussians, self._features, record=record
            )
        if record:
            self._recorded = result.hits
        return result

    def backward(self, hits: HitLists, gradients: TraceGradients) -> GaussianGradients:
        """Gradients of the raw parameters; see the protocol. ``hits`` must be of the last recording trace."""
        gaussians = self._gaussians
        assert gaussians is not None and self._recorded is hits, "hits of an older trace"
        use_threads(self.threads)
        if isinstance(hits, PacketHits):
            return self._packets.backward(hits, gradients, self._records, gaussians, self._features)
        return self._singles.backward(hits, gradients, self._records, gaussians, self._features)


def _parameters(gaussians: FlatGaussians) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    return gaussians.means_world, gaussians.quats_wxyz, gaussians.log_scales, gaussians.opacity_logits
