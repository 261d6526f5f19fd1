"""What kernels take: a named tuple for each subject, so that an argument is a subject and not an array.

numba passes the fields of a named tuple like arguments of their own. Two things it does not do with them: the
body of a parallel loop must hand them on to a function instead of writing to their arrays (it would take the
writing for useless), and may not be given tuples of tuples.

``r`` counts rays, ``n`` Gaussians,
``p`` packets, ``h`` places for hits, ``k`` spherical harmonics and ``f`` extra channels.
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
        """The arrays of ``rays``, not copied."""
        return cls(*rays.arrays)


class PackedScene(NamedTuple):
    """What hits are evaluated from: geometry.

    See :mod:`octasplat.engine.trace.cpu.kernels.octagon_hit`) and colour.
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
        """The arrays of ``gaussians``, not copied."""
        return cls(
            gaussians.means_world, gaussians.quats_wxyz, gaussians.log_scales, gaussians.opacity_logits
        )


class TraceLimits(NamedTuple):
    """Where a ray ends and normals are turned; ``eps2`` above 1 means that there is no second phase."""

    eps1: float
    eps2: float
    alpha_max: float
    max_hits: int
    flip_normal_cos: float

    @classmethod
    def from_settings(cls, settings: TraceSettings) -> "TraceLimits":
        """The limits among ``settings``."""
        eps2 = settings.second_phase_min
        return cls(
            settings.transmittance_min,
            2.0 if eps2 is None else eps2,
            settings.alpha_max,
            settings.max_hits,
            settings.flip_normal_cos,
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
    """Hits in order along each ray: those of ray r from ``starts[r]`` on.

    ``ids`` and ``rgb`` are for rays that go alone; packets keep them once for a Gaussian.
    """

    starts: Int64[np.ndarray, " r"]
    ids: Int32[np.ndarray, " h"]
    alphas: Float32[np.ndarray, " h"]
    distances: Float32[np.ndarray, " h"]
    rgb: Float32[np.ndarray, "h 3"]


class PacketHits(NamedTuple):
    """What packets keep of their hits beside :class:`HitArrays`.

    ``us`` and ``vs`` are the hits in standard deviations. ``slots`` numbers the Gaussians of each packet in
    the order in which it met them: the Gaussian in slot s of the packet that begins with ray f is
    ``slot_ids[first_place(f) + s]``, its colour is in ``slot_rgb``, and packet p has ``slot_counts[p]`` of
    them.
    """

    us: Float32[np.ndarray, " h"]
    vs: Float32[np.ndarray, " h"]
    slots: Int32[np.ndarray, " h"]
    slot_ids: Int32[np.ndarray, " h"]
    slot_rgb: Float32[np.ndarray, "h 3"]
    slot_counts: Int32[np.ndarray, " p"]


class SharedSortHits(NamedTuple):
    """What packets keep whose rays see their Gaussians in one order.

    Packet p has met ``counts[p]`` Gaussians, front to back from place ``starts[p]`` on: their ``ids``; the
    ``ray_masks`` of the rays that met them; and the ``packet_primitives`` of
    :mod:`octasplat.engine.trace.cpu.kernels.simd16`. ``frames`` are the packets' axes, e and f; ``transmittance`` is
    the transmittance in the end of each ray.
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
    depth_sum: Float32[np.ndarray, " r"]
    depth_median: Float32[np.ndarray, " r"]
    normal: Float32[np.ndarray, "r 3"]
    features: Float32[np.ndarray, "r f"]
    ray_errors: Float32[np.ndarray, " r"]
    has_geometry: bool


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
