"""The tracer that runs on any CPU: packets of neighbouring rays, and Embree for rays that come alone."""

import numba
import numpy as np
from jaxtyping import Float32, Int32, Int64

from octasplat.engine.compilation import run_ranges
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.rays import RayBatch
from octasplat.engine.threads import use_threads
from octasplat.engine.trace.cpu.bundles import (
    Forward,
    Hits,
    Limits,
    OneOrderHits,
    PacketHits,
    Parameters,
    Rays,
    Scene,
)
from octasplat.engine.trace.cpu.kernels_hit import RECORD_WORDS
from octasplat.engine.trace.cpu.kernels_rays import SPARE
from octasplat.engine.trace.cpu.kernels_records import (
    outgrown_boxes,
    refresh_records,
    write_boxes,
    write_records,
)
from octasplat.engine.trace.cpu.memory import Pool, aligned_empty, empty_result, output_gradients, outputs
from octasplat.engine.trace.cpu.packets import PacketTracer, Ways, find_packets
from octasplat.engine.trace.cpu.recording import CpuRecording
from octasplat.engine.trace.cpu.single_rays import SingleRayTracer
from octasplat.engine.trace.protocol import (
    GaussianGradients,
    Recording,
    TraceGradients,
    TraceResult,
    TraceSettings,
)
from octasplat.engine.trace.sums import add_gradients, heavier

MAX_RAYS_PER_TRACE = 1 << 28


class CpuTracer:
    """Flat Gaussians for a CPU; follows :class:`octasplat.engine.trace.protocol.Tracer`.

    Rays that lie beside each other in the batch, share their origin, have their viewer there and look about
    one way form packets; the others are followed one by one
    (:func:`octasplat.engine.trace.cpu.packets.find_packets`).

    A hierarchy only says which octagons to test, the test and the distance come from the parameters, and hits
    are ordered by (float32 distance, id). So neither the shape of a hierarchy nor the number of threads
    changes a result. Single rays test in float64; packets in float32 in a frame of their own
    (:mod:`octasplat.engine.trace.cpu.kernels_packet`), so that the two agree but for that rounding, which is
    largest for needles and for octagons seen edge on. Where ``settings.order`` is ``packet``, the rays of a
    packet composite in one order (:mod:`octasplat.engine.trace.cpu.kernels_one_order`), unless Gaussians have
    features or there is a second phase. Memory per Gaussian: a record of 64 B, 48 B of the packets' hierarchy
    and a box of 24 B; Embree's hierarchy over the boxes is built when single rays first want it.

    Not done: no gradient through octagon edges or visibility, and in one order none by depths and normals.

    Args:
        settings: where rays are cut off.
        threads: threads for building and tracing; 0 takes all that numba has.
        box_padding: fraction of its size by which a Gaussian's box for single rays is enlarged; Embree's
            hierarchy has to be built anew when one leaves it. The packets' boxes are refitted.
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
        packets: Ways = "auto",
    ) -> None:
        self.settings = settings or TraceSettings()
        self.threads = threads or int(numba.config.NUMBA_NUM_THREADS)
        self._limits = Limits.of(self.settings)
        self._padding = box_padding
        self._ways = packets
        self._pool = Pool()
        self._singles = SingleRayTracer(self._limits, threads=self.threads, build_quality=build_quality)
        self._packets = PacketTracer(self._limits, threads=self.threads, pool=self._pool)
        self._built_singles = False
        self._gaussians: FlatGaussians | None = None
        self._features = np.empty((0, 0), np.float32)
        self._records = aligned_empty((0, RECORD_WORDS))
        self._boxes = np.empty((0, 6), np.float32)
        self._build = object()

    def build(self, gaussians: FlatGaussians, features: Float32[np.ndarray, "n f"] | None = None) -> None:
        """Take over ``gaussians`` (kept by reference) and build the hierarchy around them."""
        use_threads(self.threads)
        count = len(gaussians)
        if len(self._records) != count:
            self._records = aligned_empty((count, RECORD_WORDS))
            self._boxes = np.empty((count, 6), np.float32)
        self._gaussians = gaussians
        self._features = np.empty((count, 0), np.float32) if features is None else features
        run_ranges(
            write_records, self.threads, count, self._records, *Parameters.of(gaussians), self.settings.q
        )
        self._packets.build(self._records)
        self._built_singles = False
        self._build = object()

    def refresh(self, ids: Int32[np.ndarray, " u"] | None = None) -> None:
        """Read changed parameters without rebuilding; see the protocol."""
        assert self._gaussians is not None, "build first"
        use_threads(self.threads)
        if ids is None:
            ids = np.arange(len(self._gaussians), dtype=np.int32)
        parameters, q = Parameters.of(self._gaussians), self.settings.q
        run_ranges(refresh_records, self.threads, len(ids), self._records, ids, *parameters, q)
        self._packets.refresh(self._records, ids)
        if self._built_singles:
            outgrown = np.zeros(len(ids), np.bool_)
            run_ranges(
                outgrown_boxes, self.threads, len(ids),
                outgrown, self._boxes, ids, *parameters, q, self._padding,
            )  # fmt: skip
            self._built_singles = not outgrown.any()

    def trace(self, rays: RayBatch, *, record: bool = False) -> TraceResult:
        """Follow rays; see the protocol. Directions must have unit length."""
        packets, alone = self._sorted_out(rays, coloured=True)
        count = len(rays)
        result = empty_result(count, self._features.shape[1])
        in_one_order = len(packets) > 0 and self._in_one_order
        hits = self._room(count if record and not (in_one_order and len(alone) == 0) else 0)
        forward = Forward(Rays.of(rays), self._scene, self._limits, outputs(result), hits, record)
        kept: PacketHits | OneOrderHits
        if in_one_order:
            kept = self._packets.trace_in_one_order(forward, packets, count)
        else:
            kept = self._packets.room(packets, count, recording=record)
            if len(packets):
                self._packets.trace(forward, packets, kept)
        if len(alone):
            self._singles.trace(forward, alone)
        if record:
            result.hits = CpuRecording(
                rays, result.hit_counts, packets, alone, hits, kept, self._limits, self._build
            )
        return result

    def transmittance(self, rays: RayBatch) -> Float32[np.ndarray, " r"]:
        """What light is left along each ray; see the protocol."""
        packets, alone = self._sorted_out(rays, coloured=False)
        left = np.empty(len(rays), np.float32)
        if len(packets):
            self._packets.absorb(Rays.of(rays), self._scene, packets, left)
        if len(alone):
            self._singles.absorb(Rays.of(rays), self._scene, alone, left)
        return left

    def backward(
        self, hits: Recording, gradients: TraceGradients, *, least_weight: float = 0.0
    ) -> GaussianGradients:
        """Gradients of the raw parameters; see the protocol."""
        if not isinstance(hits, CpuRecording) or hits.build is not self._build:
            raise ValueError("the recording is not of this tracer, or older than its last build")
        assert self._gaussians is not None
        use_threads(self.threads)
        if isinstance(hits.kept, OneOrderHits) and gradients.with_geometry:
            raise ValueError("depths and normals have no gradients in one order: trace with sort='ray'")
        given = output_gradients(gradients, len(hits.rays), self._features.shape[1])
        parameters = Parameters.of(self._gaussians)
        if len(hits.alone) == 0:
            return self._packets.backward(hits, given, self._scene, parameters, least_weight)
        parts = []
        if len(hits.packets):
            parts.append(self._packets.backward(hits, given, self._scene, parameters, 0.0))
        parts.append(self._singles.backward(hits, given, self._scene, parameters))
        return heavier(add_gradients(parts), least_weight)

    @property
    def _in_one_order(self) -> bool:
        one_phase = self.settings.second_phase_min is None
        return self.settings.sort == "packet" and one_phase and self._features.shape[1] == 0

    @property
    def _scene(self) -> Scene:
        assert self._gaussians is not None, "build first"
        return Scene(self._records, self._gaussians.sh, self._features)

    def _sorted_out(
        self, rays: RayBatch, *, coloured: bool
    ) -> tuple[Int64[np.ndarray, "p 2"], Int64[np.ndarray, " s"]]:
        """Packets and single rays of a batch, with what they need ready."""
        assert len(rays) < MAX_RAYS_PER_TRACE
        use_threads(self.threads)
        packets, alone = find_packets(rays, self._ways, coloured=coloured)
        if len(alone) and not self._built_singles:
            assert self._gaussians is not None, "build first"
            parameters = Parameters.of(self._gaussians)
            run_ranges(
                write_boxes, self.threads, len(self._boxes),
                self._boxes, *parameters, self.settings.q, self._padding,
            )  # fmt: skip
            self._singles.build(self._boxes)
            self._built_singles = True
        return packets, alone

    def _room(self, rays: int) -> Hits:
        """Memory for the hits of so many recorded rays."""
        places = rays * (self._limits.max_hits + SPARE)
        numbers = ((places,), np.float32)
        ids, alphas, distances, rgb = self._pool.empty(
            ((places,), np.int32), numbers, numbers, ((places, 3), np.float32)
        )
        return Hits(np.empty(rays, np.int64), ids, alphas, distances, rgb)
