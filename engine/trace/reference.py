"""The reference implementation: the same rays and Gaussians in plain float64 torch, written for readability.

Every Gaussian is tested against every ray, so it is for a few thousand of each at most. It is the judge of
the fast tracer's values and, through autograd, of its gradients. Symbols are the paper's: m the mean,
r1 r2 r3 the frame, s2 s3 the scales, o and d the ray.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.octagon import APOTHEM
from octasplat.engine.trace.protocol import TraceSettings

GRAZING_COSINE = 1e-6


@dataclass
class ReferenceParameters:
    """Raw parameters as float64 leaves that require gradients; fields as in :class:`FlatGaussians`."""

    means_world: Tensor
    quats_wxyz: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh: Tensor
    features: Tensor

    @classmethod
    def from_gaussians(
        cls, gaussians: FlatGaussians, features: np.ndarray | None = None
    ) -> "ReferenceParameters":
        """Return leaves with the values of ``gaussians``."""
        extra = np.zeros((len(gaussians), 0)) if features is None else features
        arrays = (
            gaussians.means_world,
            gaussians.quats_wxyz,
            gaussians.log_scales,
            gaussians.opacity_logits,
            gaussians.sh,
            extra,
        )
        return cls(*(torch.tensor(array, dtype=torch.float64, requires_grad=True) for array in arrays))


@dataclass
class ReferenceResult:
    """Outputs as in :class:`~octasplat.engine.trace.protocol.TraceResult`, float64; ordered ids by ray."""

    rgb_srgb: Tensor
    transmittance: Tensor
    depth_sum: Tensor
    depth_median: Tensor
    normal_world: Tensor
    features: Tensor
    hit_ids: list[np.ndarray]


def rotation_matrices(quats_wxyz: Tensor) -> Tensor:
    """Return rotation matrices (n, 3, 3) of quaternions of any length."""
    w, x, y, z = (quats_wxyz / quats_wxyz.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


def sh_basis(directions: Tensor, count: int) -> Tensor:
    """Return real spherical harmonics (r, count) of unit directions, 3DGS signs and order."""
    x, y, z = directions.unbind(-1)
    pi = np.pi
    functions = [torch.full_like(x, 0.5 / pi**0.5)]
    if count > 1:
        k = (3 / (4 * pi)) ** 0.5
        functions += [-k * y, k * z, -k * x]
    if count > 4:
        k = 0.5 * (15 / pi) ** 0.5
        functions += [
            k * x * y,
            -k * y * z,
            0.25 * (5 / pi) ** 0.5 * (2 * z * z - x * x - y * y),
            -k * x * z,
            0.5 * k * (x * x - y * y),
        ]
    if count > 9:
        a, b, c = 0.25 * (35 / (2 * pi)) ** 0.5, 0.5 * (105 / pi) ** 0.5, 0.25 * (21 / (2 * pi)) ** 0.5
        functions += [
            -a * y * (3 * x * x - y * y),
            b * x * y * z,
            -c * y * (4 * z * z - x * x - y * y),
            0.25 * (7 / pi) ** 0.5 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -c * x * (4 * z * z - x * x - y * y),
            0.5 * b * z * (x * x - y * y),
            -a * x * (x * x - 3 * y * y),
        ]
    return torch.stack(functions, dim=-1)


def trace_reference(
    parameters: ReferenceParameters,
    rays: RayBatch,
    settings: TraceSettings,
    ranks: Int64[np.ndarray, "r n"] | None = None,
) -> ReferenceResult:
    """Trace every ray against every Gaussian; see :class:`TraceSettings` for where rays end.

    Hits are composited by distance or, where ``ranks`` are given, in the order of those.
    """
    p = parameters
    d = torch.tensor(rays.directions_world, dtype=torch.float64)
    o = torch.tensor(rays.origins_world).expand_as(d)
    t_min, t_max = (torch.tensor(limit).expand(len(d))[:, None] for limit in (rays.t_min, rays.t_max))
    t_view_origins = torch.tensor(rays.t_view_origin).expand(len(d))
    frames = rotation_matrices(p.quats_wxyz)
    r1, r2, r3 = frames.unbind(-1)
    s2, s3 = p.log_scales.exp().unbind(-1)
    a = torch.sigmoid(p.opacity_logits)
    inner_radius = APOTHEM * torch.sqrt(torch.clamp(settings.q + 2 * torch.log(a.detach()), min=0))

    # --- plane hit: t = <m - o, r1> / <d, r1>, all (rays, Gaussians) pairs ---
    to_mean = p.means_world[None] - o[:, None]
    cosine = torch.einsum("rj,nj->rn", d, r1)
    grazing = cosine.abs() < GRAZING_COSINE
    t = torch.einsum("rnj,nj->rn", to_mean, r1) / torch.where(grazing, 1.0, cosine)
    offset = t[..., None] * d[:, None] - to_mean  # p - m
    u = torch.einsum("rnj,nj->rn", offset, r2) / s2
    v = torch.einsum("rnj,nj->rn", offset, r3) / s3
    alpha = torch.clamp(a * torch.exp(-0.5 * (u * u + v * v)), max=settings.alpha_max)

    # --- inside the octagon: no further along any edge normal (22.5 + 45 k degrees) than the apothem ---
    cos, sin = np.cos(np.pi / 8), np.sin(np.pi / 8)
    au, av = u.detach().abs(), v.detach().abs()
    inside = torch.maximum(au * cos + av * sin, au * sin + av * cos) <= inner_radius
    t32 = t.detach().float()
    t_cull = torch.tensor(rays.t_backface_cull).expand(len(d))[:, None]
    is_culled = (cosine > 0) & (t32 < t_cull) & (settings.flip_normal_cos > 0)
    hit = inside & ~grazing & (t32 > t_min) & (t32 < t_max) & (inner_radius > 0) & ~is_culled

    out: list[list[Tensor]] = []
    hit_ids = []
    for ray in range(len(d)):
        ids = torch.nonzero(hit[ray]).flatten()
        # Front to back; equal float32 distances are ordered by id (the sort is stable, ids ascend).
        order = t32[ray, ids] if ranks is None else torch.tensor(ranks[ray])[ids]
        ids = ids[torch.sort(order, stable=True).indices]
        ids = ids[: _hit_count(alpha[ray, ids].detach(), settings)]
        hit_ids.append(ids.numpy())
        alphas = alpha[ray, ids]
        transmittance = torch.cat([alphas.new_ones(1), torch.cumprod(1 - alphas, 0)])
        weight = alphas * transmittance[:-1]  # alpha_k T_k
        color = _colors(p.sh[ids], to_mean[ray, ids], d[ray], t_view_origins[ray])
        to_means = to_mean[ray, ids].detach()
        cosine_to_mean = (to_means * r1[ids].detach()).sum(-1) / to_means.norm(dim=-1)
        facing = torch.where(cosine_to_mean > settings.flip_normal_cos, -1.0, 1.0)
        crossing = torch.nonzero((transmittance[:-1] > 0.5) & (transmittance[1:] <= 0.5)).flatten()
        median = t[ray, ids[crossing[0]]] if len(crossing) else t.new_zeros(())
        out.append(
            [
                weight @ color,
                transmittance[-1],
                weight @ t[ray, ids],
                median,
                (weight * facing) @ r1[ids],
                weight @ p.features[ids],
            ]
        )
    rgb, transmittance, depth, median, normal, extra = (
        torch.stack(column) for column in zip(*out, strict=True)
    )
    return ReferenceResult(
        rgb_srgb=rgb,
        transmittance=transmittance,
        depth_sum=depth,
        depth_median=median,
        normal_world=normal,
        features=extra,
        hit_ids=hit_ids,
    )


def _colors(sh: Tensor, to_mean: Tensor, direction: Tensor, t_view_origin: Tensor) -> Tensor:
    """Return the colors (n, 3) of the hits of a ray, along the direction from the viewer to each mean.

    Seen from infinitely far away, that is the ray's own direction.
    """
    view = direction.expand(len(sh), 3)
    if t_view_origin.isfinite():
        view = to_mean - t_view_origin * view
    basis = sh_basis(view / view.norm(dim=-1, keepdim=True), sh.shape[1])
    return torch.clamp(0.5 + torch.einsum("nk,nkc->nc", basis, sh), min=0)


def _hit_count(alphas: Tensor, settings: TraceSettings) -> int:
    """Return the number of hits that count: by the paper's Algorithm 1 (two thresholds) or by one."""
    t1, t2, second_phase = 1.0, 1.0, False
    for k, alpha in enumerate(alphas.tolist()):
        t1 *= 1 - alpha
        if second_phase:
            t2 *= 1 - alpha
        elif t1 < settings.transmittance_min:
            second_phase = True
        done = second_phase and (settings.second_phase_min is None or t2 < settings.second_phase_min)
        if done or k + 1 == settings.max_hits:
            return k + 1
    return len(alphas)
