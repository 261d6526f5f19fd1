"""The CPU tracer: packets of neighbouring rays, and Embree for single rays."""

import numba
import numpy as np
from jaxtyping import Float32, Int32, Int64

from octasplat.engine.core.compilation import run_ranges
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.core.threads import use_threads
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.trace.cpu.kernels.kernel_args import (
    BackwardPass,
    ForwardPass,
    GaussianParameters,
    HitArrays,
    PackedScene,
    PacketHits,
    RayArrays,
    SharedSortHits,
    TraceLimits,
)
from octasplat.engine.trace.cpu.kernels.octagon_hit import PRIMITIVE_WORDS
from octasplat.engine.trace.cpu.kernels.packed_primitives import (
    pack_primitives,
    refit_outgrown_boxes,
    repack_primitives,
    write_boxes,
)
from octasplat.engine.trace.cpu.kernels.rays import HIT_PADDING
from octasplat.engine.trace.cpu.memory import (
    ArrayPool,
    aligned_empty,
    empty_result,
    output_arrays,
    output_gradient_arrays,
)
from octasplat.engine.trace.cpu.packets import PacketMode, PacketTracer, find_packets
from octasplat.engine.trace.cpu.recording import CpuRecording
from octasplat.engine.trace.cpu.single_rays import SingleRayTracer
from octasplat.engine.trace.gradient_sums import add_gradients, drop_low_weight
from octasplat.engine.trace.protocol import (
    GaussianGradients,
    Recording,
    TraceGradients,
    TraceResult,
    TraceSettings,
)

MAX_RAYS_PER_TRACE = 1 << 28  # a hit's ray number has 28 bits in single_backward


class CpuTracer:
    """Tracer of flat Gaussians on a CPU; implements :class:`octasplat.engine.trace.protocol.Tracer`.

    Rays that are adjacent in the batch, share their origin and viewer and have similar directions form
    packets; the others are traced one by one (:func:`octasplat.engine.trace.cpu.packets.find_packets`).

    A hierarchy only says which octagons to test; test and distance depend on the parameters only, and
    hits are ordered by (float32 distance, id). So neither the shape of a hierarchy nor the number of threads
    changes a result. Single rays are tested in float64, packets in float32 in a local frame
    (:mod:`octasplat.engine.trace.cpu.kernels.packet_candidates`): they agree up to that rounding, which is
    largest for thin octagons and for those seen edge-on. If ``settings.sort`` is ``packet``, the rays of a
    packet are composited in one shared order (:mod:`octasplat.engine.trace.cpu.kernels.shared_sort`), unless
    Gaussians have features or there is a second phase. Memory per Gaussian: a record of 64 B, 48 B of the
    packets' hierarchy and a box of 24 B; Embree's hierarchy over the boxes is built on demand.

    There is no gradient through octagon edges or visibility, and with a shared order none by depths and
    normals.

    Args:
        settings: where rays are cut off.
        threads: threads for building and tracing; 0 takes all that numba has.
        box_padding: fraction of its size by which a Gaussian's box for single rays is enlarged; Embree's
            hierarchy has to be built anew when one leaves it. The packets' boxes are refitted.
        build_quality: Embree's: 0 low, 1 medium, 2 high.
        packet_mode: whether rays go in packets: "auto" decides by what is faster.
    """

    def __init__(
        self,
        settings: TraceSettings | None = None,
        *,
        threads: int = 0,
        box_padding: float = 0.0,
        build_quality: int = 1,
        packet_mode: PacketMode = "auto",
    ) -> None:
        self.settings = settings or TraceSettings()
        self.threads = threads or int(numba.config.NUMBA_NUM_THREADS)
        self._limits = TraceLimits.from_settings(self.settings)
        self._padding = box_padding
        self._packet_mode = packet_mode
        self._pool = ArrayPool()
        self._single_tracer = SingleRayTracer(self._limits, threads=self.threads, build_quality=build_quality)
        self._packet_tracer = PacketTracer(self._limits, threads=self.threads, pool=self._pool)
        self._is_single_built = False
        self._gaussians: FlatGaussians | None = None
        self._features = np.empty((0, 0), np.float32)
        self._primitives = aligned_empty((0, PRIMITIVE_WORDS))
        self._boxes = np.empty((0, 6), np.float32)
        self._build_id = object()  # compared by identity: a recording belongs to one build

    def build(self, gaussians: FlatGaussians, features: Float32[np.ndarray, "n f"] | None = None) -> None:
        """Build the hierarchy around ``gaussians``, which are kept by reference."""
        use_threads(self.threads)
        count = len(gaussians)
        if len(self._primitives) != count:
            self._primitives = aligned_empty((count, PRIMITIVE_WORDS))
            self._boxes = np.empty((count, 6), np.float32)
        self._gaussians = gaussians
        self._features = np.empty((count, 0), np.float32) if features is None else features
        run_ranges(
            pack_primitives,
            self.threads,
            count,
            self._primitives,
            GaussianParameters.from_gaussians(gaussians),
            self.settings.q,
        )
        if self._packet_mode != "never":
            self._packet_tracer.build(self._primitives)
        self._is_single_built = False  # built when the first single ray asks for it
        self._build_id = object()

    def refresh(self, ids: Int32[np.ndarray, " u"] | None = None) -> None:
        """Read changed parameters without rebuilding; see the protocol."""
        assert self._gaussians is not None, "build first"
        use_threads(self.threads)
        if ids is None:
            ids = np.arange(len(self._gaussians), dtype=np.int32)
        parameters, q = GaussianParameters.from_gaussians(self._gaussians), self.settings.q
        run_ranges(repack_primitives, self.threads, len(ids), self._primitives, ids, parameters, q)
        if self._packet_mode != "never":
            self._packet_tracer.refresh(self._primitives, ids)
        if self._is_single_built:
            outgrown = np.zeros(len(ids), np.bool_)
            run_ranges(
                refit_outgrown_boxes, self.threads, len(ids),
                outgrown, self._boxes, ids, parameters, q, self._padding,
            )  # fmt: skip
            # a box that has changed is not in Embree's hierarchy yet
            self._is_single_built = not outgrown.any()

    def trace(self, rays: RayBatch, *, record: bool = False) -> TraceResult:
        """Trace rays of unit directions; see the protocol."""
        packets, alone = self._split_packets(rays, needs_color=True)
        count = len(rays)
        result = empty_result(count, self._features.shape[1])
        in_one_order = len(packets) > 0 and self._uses_shared_sort
        # a shared order keeps hits of its own
        hits = self._allocate_hits(count if record and not (in_one_order and len(alone) == 0) else 0)
        forward = ForwardPass(
            rays=RayArrays.from_batch(rays),
            scene=self._packed_scene,
            limits=self._limits,
            out=output_arrays(result),
            hits=hits,
            is_recording=record,
        )
        packet_hits: PacketHits | SharedSortHits
        if in_one_order:
            packet_hits = self._packet_tracer.trace_shared_sort(forward, packets, count)
        else:
            packet_hits = self._packet_tracer.allocate_hits(packets, count, is_recording=record)
            if len(packets):
                self._packet_tracer.trace(forward, packets, packet_hits)
        if len(alone):
            self._single_tracer.trace(forward, alone)
        if record:
            result.recording = CpuRecording(
                rays=rays,
                counts=result.hit_counts,
                packets=packets,
                single_rays=alone,
                hits=hits,
                packet_hits=packet_hits,
                limits=self._limits,
                build_id=self._build_id,
            )
        return result

    def transmittance(self, rays: RayBatch) -> Float32[np.ndarray, " r"]:
        """Return the transmittance along each ray; see the protocol."""
        packets, alone = self._split_packets(rays, needs_color=False)
        left = np.empty(len(rays), np.float32)
        if len(packets):
            self._packet_tracer.write_transmittance(
                RayArrays.from_batch(rays), self._packed_scene, packets, left
            )
        if len(alone):
            self._single_tracer.write_transmittance(
                RayArrays.from_batch(rays), self._packed_scene, alone, left
            )
        return left

    def backward(
        self, recording: Recording, gradients: TraceGradients, *, min_blend_weight: float = 0.0
    ) -> GaussianGradients:
        """Return gradients of the raw parameters; see the protocol."""
        if not isinstance(recording, CpuRecording) or recording.build_id is not self._build_id:
            raise ValueError("the recording is not of this tracer, or older than its last build")
        assert self._gaussians is not None
        use_threads(self.threads)
        if isinstance(recording.packet_hits, SharedSortHits) and gradients.has_geometry:
            raise ValueError("depths and normals have no gradients in one order: trace with sort='ray'")
        given = output_gradient_arrays(gradients, len(recording.rays), self._features.shape[1])
        backward = BackwardPass(
            RayArrays.from_batch(recording.rays), GaussianParameters.from_gaussians(self._gaussians),
            self._packed_scene, self._limits, given,
        )  # fmt: skip
        if len(recording.single_rays) == 0:
            return self._packet_tracer.backward(recording, backward, min_blend_weight)
        parts = []
        if len(recording.packets):
            # only the sum over both parts is compared with the least weight
            parts.append(self._packet_tracer.backward(recording, backward, 0.0))
        parts.append(self._single_tracer.backward(recording, backward))
        return drop_low_weight(add_gradients(parts), min_blend_weight)

    @property
    def _uses_shared_sort(self) -> bool:
        one_phase = self.settings.second_phase_min is None
        return self.settings.sort == "packet" and one_phase and self._features.shape[1] == 0

    @property
    def _packed_scene(self) -> PackedScene:
        assert self._gaussians is not None, "build first"
        return PackedScene(self._primitives, self._gaussians.sh, self._features)

    def _split_packets(
        self, rays: RayBatch, *, needs_color: bool
    ) -> tuple[Int64[np.ndarray, "p 2"], Int64[np.ndarray, " s"]]:
        """Return the packets and single rays of a batch, with their buffers allocated."""
        assert len(rays) < MAX_RAYS_PER_TRACE
        use_threads(self.threads)
        packets, alone = find_packets(rays, self._packet_mode, needs_color=needs_color)
        if len(alone) and not self._is_single_built:
            assert self._gaussians is not None, "build first"
            parameters = GaussianParameters.from_gaussians(self._gaussians)
            run_ranges(
                write_boxes, self.threads, len(self._boxes),
                self._boxes, parameters, self.settings.q, self._padding,
            )  # fmt: skip
            self._single_tracer.build(self._boxes)
            self._is_single_built = True
        return packets, alone

    def _allocate_hits(self, rays: int) -> HitArrays:
        """Return buffers for the hits of ``rays`` recorded rays."""
        places = rays * (self._limits.max_hits + HIT_PADDING)
        numbers = ((places,), np.float32)
        ids, alphas, distances, rgb = self._pool.empty(
            ((places,), np.int32), numbers, numbers, ((places, 3), np.float32)
        )
        return HitArrays(np.empty(rays, np.int64), ids, alphas, distances, rgb)
