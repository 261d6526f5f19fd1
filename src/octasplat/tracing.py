"""The ray tracer as a differentiable function of torch, for training loops of one's own."""

import weakref
from collections import deque
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import FunctionCtx, once_differentiable

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.scene_metadata import UNKNOWN_METADATA, SceneMetadata
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import TraceGradients, Tracer, TraceSettings
from octasplat.engine.trace.ray_gradients import ray_gradients
from octasplat.operation_calls import check_threads
from octasplat.scenes import Scene

_MIN_ALPHA = 1e-8
"""Rays that met less than this have no depth."""


@dataclass(eq=False)
class GaussianTensors:
    """The parameters of ``n`` flat Gaussians before their activations, as tensors on the CPU.

    Attributes:
        means: centres, world units.
        quats: rotations (w, x, y, z) of any length.
        log_scales: natural logarithms of the standard deviations in the plane.
        opacity_logits: what the sigmoid turns into opacities.
        sh: spherical harmonics of the display color; color = max(0, 1/2 + sum_k sh[k] Y_k(direction)).
        features: any further numbers, composited like colors.
        facts: what is known of the scene as a whole; it decides how the scene is traced.
        trained_with: how the run of the scene has traced it, which comes before that; None of a file.

    >>> import octasplat as osp
    >>> parameters = osp.GaussianTensors.of(osp.load("scene.ply"))
    >>> parameters.means.shape, parameters.means.requires_grad
    (torch.Size([1200, 3]), True)
    >>> len(parameters.tensors())
    5
    """

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    log_scales: Float[Tensor, "n 2"]
    opacity_logits: Float[Tensor, " n"]
    sh: Float[Tensor, "n k 3"]
    features: Float[Tensor, "n f"] | None = None
    facts: SceneMetadata = UNKNOWN_METADATA
    trained_with: TraceSettings | None = None

    @classmethod
    def of(cls, scene: Scene, *, requires_grad: bool = True) -> "GaussianTensors":
        """Return leaves with the parameters of a scene, copied; its channels do not come along."""
        arrays = (scene.means, scene.quats, scene.log_scales, scene.opacity_logits, scene.sh)
        leaves = [torch.tensor(array, requires_grad=requires_grad) for array in arrays]
        means, quats, log_scales, opacity_logits, sh = leaves
        return cls(
            means, quats, log_scales, opacity_logits, sh, facts=scene.facts, trained_with=scene.trained_with
        )

    def tensors(self) -> list[Tensor]:
        """Return the tensors, as an optimiser takes them; no features where there are none."""
        # In the order of the fields, which is that of the function's arguments.
        found = (getattr(self, part.name) for part in fields(self))
        return [part for part in found if isinstance(part, Tensor)]

    def scene(self) -> Scene:
        """Return the scene with these parameters, copied."""
        # without the features, which a scene does not hold
        gaussians = _as_flat_gaussians(*(_as_float32(tensor) for tensor in self.tensors()[:5]))
        return Scene(gaussians.copy(), self.facts, trained_with=self.trained_with)


@dataclass(eq=False)
class Rays:
    """``r`` rays, which see what lies between ``t_min`` and ``t_max`` of their length.

    Attributes:
        origins: where they come from; one row stands for all.
        directions: where they go, of any length; distances are in world units all the same.
        t_min: distance at which they begin.
        t_max: distance at which they end.

    >>> import octasplat as osp
    >>> rays = osp.Rays.of(osp.load("scene.ply").camera(width_px=96, height_px=64))
    >>> rays.origins.shape, rays.directions.shape
    (torch.Size([1, 3]), torch.Size([6144, 3]))
    >>> rays[:100].directions.shape
    torch.Size([100, 3])
    """

    origins: Float[Tensor, "#r 3"]
    directions: Float[Tensor, "r 3"]
    t_min: float = 0.0
    t_max: float = float("inf")

    @classmethod
    def of(cls, camera: PinholeCamera) -> "Rays":
        """Return the rays through the pixels of a camera, row by row."""
        rays = camera.rays().rays
        return cls(torch.tensor(rays.origins_world), torch.tensor(rays.directions_world), camera.near_world)

    def __len__(self) -> int:
        return len(self.directions)

    def __getitem__(self, which: Any) -> "Rays":
        """Return the rays of a slice, a mask or numbers; of a single number, one ray."""
        if np.ndim(which) == 0 and not isinstance(which, slice):
            which = [int(which)]
        # An origin that all rays share stays one, whichever of them are chosen.
        shared = len(self.origins) == 1 and len(self) != 1
        origins = self.origins if shared else self.origins[which]
        return Rays(origins, self.directions[which], self.t_min, self.t_max)


@dataclass(frozen=True, eq=False)
class TracedRays:
    """Result of tracing rays through a scene.

    Attributes:
        rgb: display colors, multiplied by alpha: with a background b, a picture is rgb + (1 - alpha) b.
        alpha: how much of the ray the Gaussians hide.
        depth: mean distance, world units; 0 where nothing was met.
        depth_median: distance of the Gaussian with which half of the light is gone; 0 where it never is.
        normal: sum of the normals by weight, towards the viewer; its length is at most alpha.
        features: sum of the Gaussians' features by weight.

    >>> import octasplat as osp
    >>> scene = osp.load("scene.ply")
    >>> seen = osp.trace(scene, scene.camera(width_px=96, height_px=64))
    >>> picture = (seen.rgb + (1 - seen.alpha)[:, None]).reshape(64, 96, 3)  # over white
    >>> picture.shape
    torch.Size([64, 96, 3])
    """

    rgb: Float[Tensor, "r 3"]
    alpha: Float[Tensor, " r"]
    depth: Float[Tensor, " r"]
    depth_median: Float[Tensor, " r"]
    normal: Float[Tensor, "r 3"]
    features: Float[Tensor, "r f"]


def trace(
    scene: Scene | GaussianTensors,
    rays: Rays | PinholeCamera,
    *,
    settings: TraceSettings | None = None,
    threads: int = 0,
) -> TracedRays:
    """Return what rays see of flat Gaussians, differentiably.

    Everything has gradients by all parameters and by the origins and directions of the rays: those of the
    compositing, the falloff, the planes and the view-dependent color. There are none through the edges of
    the octagons and the order of the hits. Rays beside each other that share their origin, as those of a
    camera do, are traced together and fastest.

    Args:
        scene: parameters; a :class:`Scene` is taken as it is, without gradients.
        rays: rays, or a camera for those through its pixels, row by row.
        settings: where rays are cut off; None takes those of the scene's run, or the usual ones.
        threads: 0 takes all cores.

    Raises:
        ConfigError: tensors do not have the shapes that their classes name, or the number of threads is none.
        TypeError: what is given is no scene or no rays.

    >>> import octasplat as osp
    >>> scene = osp.load("scene.ply")
    >>> parameters = osp.GaussianTensors.of(scene)
    >>> seen = osp.trace(parameters, scene.camera(width_px=96, height_px=64))
    >>> seen.rgb.shape, seen.depth.shape, seen.normal.shape, seen.alpha.shape
    (torch.Size([6144, 3]), torch.Size([6144]), torch.Size([6144, 3]), torch.Size([6144]))
    >>> (1 - seen.alpha).mean().backward()
    >>> parameters.opacity_logits.grad.shape
    torch.Size([1200])
    """
    check_threads(threads)
    if not isinstance(scene, Scene | GaussianTensors):
        raise TypeError(f"trace takes a Scene or GaussianTensors, not {type(scene).__name__}")
    if not isinstance(rays, Rays | PinholeCamera):
        raise TypeError(f"trace takes Rays or one camera, not {type(rays).__name__}")
    given = GaussianTensors.of(scene, requires_grad=False) if isinstance(scene, Scene) else scene
    if settings is None:
        settings = scene.trained_with or TraceSettings(flip_normal_cos=scene.facts.turned_beyond)
    lines = Rays.of(rays) if isinstance(rays, PinholeCamera) else rays
    _check_shapes(given, lines)
    # By torch, so that the gradients of directions of any length are right.
    directions = lines.directions / lines.directions.norm(dim=-1, keepdim=True)
    features = given.features
    if features is None:
        # The function takes a tensor in each place.
        features = given.means.new_zeros((len(given.means), 0))
    found: tuple[Tensor, ...] = _TraceFunction.apply(  # type: ignore[no-untyped-call]
        given.means, given.quats, given.log_scales, given.opacity_logits, given.sh, features,
        lines.origins, directions, _TraceConstants(settings, lines.t_min, lines.t_max, threads),
    )  # fmt: skip
    rgb, transmittance, depth_sum, depth_median, normal, extra = found
    alpha = 1 - transmittance
    met = alpha > _MIN_ALPHA
    # The inner choice keeps 0/0 out of the other branch, whose gradient would be NaN for all.
    depth = torch.where(met, depth_sum / torch.where(met, alpha, 1.0), 0.0)
    return TracedRays(rgb, alpha, depth, depth_median, normal, extra)


def _check_shapes(given: GaussianTensors, rays: Rays) -> None:
    """Refuse tensors of other shapes than the kernels read, which would read beyond them.

    Raises:
        ConfigError: one has another shape; the sentence names it.
    """
    n, r = len(given.means), len(rays.directions)
    for name, wanted in (
        ("means", (n, 3)),
        ("quats", (n, 4)),
        ("log_scales", (n, 2)),
        ("opacity_logits", (n,)),
        ("sh", (n, None, 3)),
        ("features", (n, None)),
    ):
        if (tensor := getattr(given, name)) is not None:
            _check_shape(name, tensor, wanted)
    if given.sh.shape[1] not in (1, 4, 9, 16):
        raise ConfigError(f"sh: has {given.sh.shape[1]} coefficients a Gaussian; it must be 1, 4, 9 or 16.")
    _check_shape("directions", rays.directions, (r, 3))
    _check_shape("origins", rays.origins, (1 if len(rays.origins) == 1 else r, 3))


def _check_shape(name: str, tensor: Tensor, wanted: tuple[int | None, ...]) -> None:
    if not isinstance(tensor, Tensor):
        raise ConfigError(f"{name}: must be a tensor of torch, not {type(tensor).__name__}.")
    shape = tuple(tensor.shape)
    if len(shape) != len(wanted) or any(
        side not in (None, own) for own, side in zip(shape, wanted, strict=True)
    ):
        text = ", ".join("k" if side is None else str(side) for side in wanted)
        raise ConfigError(f"{name}: has the shape {shape}; it must be ({text}{',' * (len(wanted) == 1)}).")


@dataclass(frozen=True)
class _TraceConstants:
    """Inputs of the trace that are not differentiated."""

    settings: TraceSettings
    t_min: float
    t_max: float
    threads: int


class _PooledTracer:
    """A tracer of which nobody else makes use until this object is gone; its memory serves the next one."""

    def __init__(self, settings: TraceSettings, threads: int) -> None:
        free = _TRACER_POOL.setdefault((settings, threads), deque(maxlen=_MAX_POOLED_TRACERS))
        # Taking from a deque is atomic, so that threads need no lock.
        try:
            self.tracer = free.pop()
        except IndexError:
            self.tracer = make_tracer(settings, threads=threads)
        weakref.finalize(self, free.append, self.tracer).atexit = False


_MAX_POOLED_TRACERS = 2
"""Tracers that are kept for each kind of settings: fresh memory costs more than the tracing in it."""
_TRACER_POOL: dict[tuple[TraceSettings, int], deque[Tracer]] = {}


class _TraceFunction(torch.autograd.Function):
    """The tracer with its gradients; all tensors may be of any floating type, results are float32."""

    @staticmethod
    def forward(ctx: FunctionCtx, *arguments: Any) -> tuple[Tensor, ...]:
        *tensors, limits = arguments
        means, quats, log_scales, logits, sh, features, origins, directions = map(_as_float32, tensors)
        gaussians = _as_flat_gaussians(means, quats, log_scales, logits, sh)
        rays = RayBatch(origins, directions, limits.t_min, limits.t_max)
        lease = _PooledTracer(limits.settings, limits.threads)
        tracer = lease.tracer
        tracer.build(gaussians, features if features.shape[1] else None)
        traced = tracer.trace(rays, record=any(ctx.needs_input_grad))  # type: ignore[attr-defined]
        ctx.save_for_backward(*tensors)  # so that torch notices where they are changed before backward
        ctx.state = gaussians, rays, lease, traced.recording, features  # type: ignore[attr-defined]
        return tuple(
            torch.from_numpy(array)
            for array in (
                traced.rgb_srgb, traced.transmittance, traced.depth_sum, traced.depth_median,
                traced.normal_world, traced.features,
            )
        )  # fmt: skip

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, *given: Tensor) -> tuple[Tensor | None, ...]:
        tensors = ctx.saved_tensors
        gaussians, rays, lease, hits, features = ctx.state
        tracer = lease.tracer
        gradients = TraceGradients(*(_as_float32(part) for part in given))
        # One for each argument of forward; the last one is not differentiated.
        out: list[Tensor | None] = [None] * 9
        # The first six arguments are the Gaussians' parameters, the next two are the rays.
        if any(ctx.needs_input_grad[:6]):
            found = tracer.backward(hits, gradients).numpy()
            rows = (
                found.means_world, found.quats_wxyz, found.log_scales, found.opacity_logits, found.sh,
                found.features,
            )  # fmt: skip
            # Only the Gaussians that were hit have rows; all others have gradients of zero.
            places = torch.from_numpy(found.ids.astype(np.int64))
            for number, part in enumerate(rows):
                if ctx.needs_input_grad[number]:
                    dense = torch.zeros_like(tensors[number])
                    dense[places] = torch.from_numpy(part).to(dense.dtype)
                    out[number] = dense
        if any(ctx.needs_input_grad[6:8]):
            extra = features if features.shape[1] else None
            by_ray = ray_gradients(gaussians, rays, hits, gradients, tracer.settings, extra)
            origins, directions = by_ray.origins_world, by_ray.directions_world
            # One origin that stands for all rays has the sum of their gradients.
            if len(rays.origins_world) == 1:
                origins = origins.sum(axis=0, keepdims=True)
            for number, part in ((6, origins), (7, directions)):
                out[number] = torch.from_numpy(part).to(tensors[number].dtype)
        return tuple(out)


def _as_flat_gaussians(
    means: np.ndarray, quats: np.ndarray, log_scales: np.ndarray, logits: np.ndarray, sh: np.ndarray
) -> FlatGaussians:
    return FlatGaussians(means, quats, log_scales, logits, sh)


def _as_float32(tensor: Tensor) -> np.ndarray:
    """Return the tensor's values as the tracer takes them, not copied where they are that."""
    return np.require(tensor.detach().cpu().to(torch.float32).numpy(), np.float32, ["C", "W"])
