"""Arguments of the kernels: a named tuple for each subject.

numba passes the fields of a named tuple as separate arguments, with two limits: the body of a parallel loop
must pass the tuple to a function instead of writing to its arrays (numba would remove the writes as dead
code), and it may not be given tuples of tuples.

Dimensions: ``r`` rays, ``n`` Gaussians, ``p`` packets, ``h`` hit slots, ``k`` spherical harmonics and ``f``
extra channels.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64, UInt64

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.trace.protocol import TraceSettings


class RayArrays(NamedTuple):
    """A :class:`octasplat.engine.core.rays.RayBatch`; a single origin, limit or viewer stands for all."""

    origins: Float32[np.ndarray, "#r 3"]
    directions: Float32[np.ndarray, "r 3"]
    t_min: Float32[np.ndarray, "#r"]
    t_max: Float32[np.ndarray, "#r"]
    t_view_origin: Float32[np.ndarray, "#r"]
    t_backface_cull: Float32[np.ndarray, "#r"]

    @classmethod
    def from_batch(cls, rays: RayBatch) -> "RayArrays":
        """Return the arrays of ``rays``, not copied."""
        return cls(*rays.arrays)


class PackedScene(NamedTuple):
    """Geometry and color from which hits are evaluated.

    See :mod:`octasplat.engine.trace.cpu.kernels.octagon_hit` for the geometry.
    """

    primitives: Float32[np.ndarray, "n 16"]
    sh: Float32[np.ndarray, "n k 3"]
    features: Float32[np.ndarray, "n f"]


class GaussianParameters(NamedTuple):
    """The raw geometry of the Gaussians.

    Fields as in :class:`octasplat.engine.gaussians.model.FlatGaussians`.
    """

    means: Float32[np.ndarray, "n 3"]
    quats: Float32[np.ndarray, "n 4"]
    log_scales: Float32[np.ndarray, "n 2"]
    logits: Float32[np.ndarray, " n"]

    @classmethod
    def from_gaussians(cls, gaussians: FlatGaussians) -> "GaussianParameters":
        """Return the arrays of ``gaussians``, not copied."""
        return cls(
            gaussians.means_world, gaussians.quats_wxyz, gaussians.log_scales, gaussians.opacity_logits
        )


NO_SECOND_PHASE = 2.0
"""Value of ``eps2`` that no transmittance reaches: kernels take a threshold above 1 for a single phase."""


class TraceLimits(NamedTuple):
    """Parameters of compositing, from :class:`octasplat.engine.trace.protocol.TraceSettings`.

    Attributes:
        eps1: transmittance below which a ray, or its first phase, ends.
        eps2: transmittance below which the second phase ends; :data:`NO_SECOND_PHASE` switches it off.
        alpha_max: alpha is clamped to this.
        max_hits: most Gaussians on a ray.
        flip_normal_cos: a normal that points away from the viewer is flipped where its cosine to the
            direction from the ray's origin to the mean is larger.
    """

    eps1: float
    eps2: float
    alpha_max: float
    max_hits: int
    flip_normal_cos: float

    @classmethod
    def from_settings(cls, settings: TraceSettings) -> "TraceLimits":
        """Return the kernels' parameters taken from ``settings``."""
        second_phase_min = settings.second_phase_min
        return cls(
            eps1=settings.transmittance_min,
            eps2=NO_SECOND_PHASE if second_phase_min is None else second_phase_min,
            alpha_max=settings.alpha_max,
            max_hits=settings.max_hits,
            flip_normal_cos=settings.flip_normal_cos,
        )


class OutputArrays(NamedTuple):
    """The arrays of a :class:`octasplat.engine.trace.protocol.TraceResult`, to be written."""

    rgb: Float32[np.ndarray, "r 3"]
    transmittance: Float32[np.ndarray, " r"]
    depth_sum: Float32[np.ndarray, " r"]
    depth_median: Float32[np.ndarray, " r"]
    normal: Float32[np.ndarray, "r 3"]
    features: Float32[np.ndarray, "r f"]
    counts: Int32[np.ndarray, " r"]


class HitArrays(NamedTuple):
    """Hits in order along each ray: those of ray r start at ``starts[r]``.

    ``ids`` and ``rgb`` are for single rays; packets store them once for each Gaussian.
    """

    starts: Int64[np.ndarray, " r"]
    ids: Int32[np.ndarray, " h"]
    alphas: Float32[np.ndarray, " h"]
    distances: Float32[np.ndarray, " h"]
    rgb: Float32[np.ndarray, "h 3"]


class PacketHits(NamedTuple):
    """Hits of packets beside :class:`HitArrays`.

    ``us`` and ``vs`` are the hits in standard deviations. ``slots`` numbers the Gaussians of each packet in
    the order in which it met them: the Gaussian in slot s of the packet that begins with ray f is
    ``slot_ids[first_place(f) + s]``, its color is in ``slot_rgb``, and packet p has ``slot_counts[p]`` of
    them.
    """

    us: Float32[np.ndarray, " h"]
    vs: Float32[np.ndarray, " h"]
    slots: Int32[np.ndarray, " h"]
    slot_ids: Int32[np.ndarray, " h"]
    slot_rgb: Float32[np.ndarray, "h 3"]
    slot_counts: Int32[np.ndarray, " p"]


class SharedSortHits(NamedTuple):
    """Hits of packets whose rays share one order of Gaussians.

    Packet p has met ``counts[p]`` Gaussians, front to back from place ``starts[p]`` on: their ``ids``; the
    ``ray_masks`` of the rays that met them; and the ``packet_primitives`` of
    :mod:`octasplat.engine.trace.cpu.kernels.simd16`. ``frames`` are the packets' axes, e and f;
    ``transmittance`` is the transmittance in the end of each ray.
    """

    ids: Int32[np.ndarray, " h"]
    ray_masks: UInt64[np.ndarray, " h"]
    packet_primitives: Float32[np.ndarray, "h 16"]
    starts: Int64[np.ndarray, " p"]
    counts: Int32[np.ndarray, " p"]
    frames: Float64[np.ndarray, "p 9"]
    transmittance: Float32[np.ndarray, " r"]


class ForwardPass(NamedTuple):
    """A forward pass: ``hits`` are only written if it is ``is_recording``."""

    rays: RayArrays
    scene: PackedScene
    limits: TraceLimits
    out: OutputArrays
    hits: HitArrays
    is_recording: bool


class OutputGradientArrays(NamedTuple):
    """Gradients of a loss by each output; those of depths and normals are zero unless ``has_geometry``."""

    rgb: Float32[np.ndarray, "r 3"]
    transmittance: Float32[np.ndarray, " r"]
    features: Float32[np.ndarray, "r f"]
    ray_errors: Float32[np.ndarray, " r"]
    depth_sum: Float32[np.ndarray, " r"]
    depth_median: Float32[np.ndarray, " r"]
    normal: Float32[np.ndarray, "r 3"]
    has_geometry: bool


class BackwardPass(NamedTuple):
    """A backward pass: rays, Gaussians as parameters and as packed, and gradients by the outputs."""

    rays: RayArrays
    parameters: GaussianParameters
    scene: PackedScene
    limits: TraceLimits
    output_gradients: OutputGradientArrays


class GaussianGradientArrays(NamedTuple):
    """The arrays of a :class:`octasplat.engine.trace.protocol.GaussianGradients`, to be written."""

    ids: Int32[np.ndarray, " u"]
    means: Float32[np.ndarray, "u 3"]
    quats: Float32[np.ndarray, "u 4"]
    log_scales: Float32[np.ndarray, "u 2"]
    logits: Float32[np.ndarray, " u"]
    sh: Float32[np.ndarray, "u k 3"]
    features: Float32[np.ndarray, "u f"]
    weights: Float32[np.ndarray, " u"]
    errors: Float32[np.ndarray, " u"]
    counts: Int32[np.ndarray, " u"]


class GaussianSegments(NamedTuple):
    """Rows sorted by Gaussian: the s-th one that was hit has rows ``order[starts[s] : starts[s + 1]]``."""

    order: Int32[np.ndarray, " e"]
    ids: Int32[np.ndarray, " e"]
    starts: Int64[np.ndarray, " s1"]


class BvhArrays(NamedTuple):
    """The bounding volume hierarchy, laid out as in :mod:`octasplat.engine.trace.cpu.kernels.packet_bvh`."""

    nodes: Float32[np.ndarray, "m 6 8"]
    level_starts: Int64[np.ndarray, " l"]
    leaf_blocks: Float32[np.ndarray, "b 9 8"]
    order: Int32[np.ndarray, " k"]


class Frustum(NamedTuple):
    """The pyramid around the rays of a packet.

    ``planes`` are inward normals, their positive and their negative parts; ``frame`` the axis, two
    directions across it, the range of slopes and bins per slope, and ``frame_float32`` the same in float32;
    ``prefix_masks`` the bits of the rays in the bins before each, along either slope.
    """

    planes: Float32[np.ndarray, "5 9"]
    frame: Float64[np.ndarray, "15"]
    frame_float32: Float32[np.ndarray, "15"]
    prefix_masks: UInt64[np.ndarray, "2 65"]


class TraversalScratch(NamedTuple):
    """Memory of a traversal: pending nodes and blocks, bins and distances of a block, sort buckets."""

    stack: Int64[np.ndarray, " s"]
    block_queue: Int64[np.ndarray, " w"]
    bins: Int32[np.ndarray, "4 8"]
    distances: Float32[np.ndarray, "2 8"]
    histogram: Int32[np.ndarray, "256"]


class Candidates(NamedTuple):
    """The candidates of a packet, ``c`` at most.

    As they are found: ``curve_indices``, the place on the curve; ``keys``, the likely distance in the upper
    half and the number in the lower; ``min_distances``, the least distance; ``cells``, where in the cross
    section; ``ray_masks``, the bits of the rays. In order: ``ids``; ``min_distance_after``, where a chunk
    begins, the least distance of what follows; ``block_ray_masks``, the bits of the rays that may meet any
    of a block's eight, and the same by ray, ``ray_block_masks``; ``blocks``, what is tested; ``slots``, the
    number under which the packet met it, or -1; ``color_normals``, what it shows, by that number.

    What one ray has met, in the order in which it was tested: ``hit_keys``, the distance in the upper half
    and the place in this order in the lower, which are then sorted; ``alphas``, ``opacities``, ``us`` and
    ``vs``; and ``hit_candidates``, which candidates they are.
    """

    curve_indices: Int32[np.ndarray, " c"]
    keys: UInt64[np.ndarray, " c"]
    min_distances: Float32[np.ndarray, " c"]
    cells: Int32[np.ndarray, " c"]
    ray_masks: UInt64[np.ndarray, " c"]
    ids: Int32[np.ndarray, " c"]
    min_distance_after: Float32[np.ndarray, " c1"]
    block_ray_masks: UInt64[np.ndarray, " b"]
    ray_block_masks: UInt64[np.ndarray, "w 64"]
    blocks: Float32[np.ndarray, "b 12 8"]
    slots: Int32[np.ndarray, " c"]
    color_normals: Float64[np.ndarray, "c 8"]
    hit_keys: UInt64[np.ndarray, " c8"]
    alphas: Float32[np.ndarray, " c8"]
    opacities: Float32[np.ndarray, " c8"]
    us: Float32[np.ndarray, " c8"]
    vs: Float32[np.ndarray, " c8"]
    hit_candidates: Int32[np.ndarray, " c8"]
