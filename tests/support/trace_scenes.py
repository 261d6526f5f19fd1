"""Gaussians, rays and the comparison with the slow twin, shared by the tests of the tracer."""

from dataclasses import fields

import numpy as np
import torch

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.trace.cpu.tracer import CpuTracer
from octasplat.engine.trace.protocol import GaussianGradients, TraceGradients, TraceResult, TraceSettings
from octasplat.engine.trace.reference import ReferenceParameters, ReferenceResult, trace_reference

PACKETS = ["auto"]
"""Whether tracers made here send rays in packets; tests that run both ways change it."""
OUTPUTS = ("rgb_srgb", "transmittance", "depth_sum", "depth_median", "normal_world", "features")
PARAMETERS = ("means_world", "quats_wxyz", "log_scales", "opacity_logits", "sh", "features")
VALUE_TOLERANCE, GRADIENT_TOLERANCE = 1e-5, 1e-4


def f32(array: object) -> np.ndarray:
    return np.ascontiguousarray(array, dtype=np.float32)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def make_cloud(
    rng: np.random.Generator,
    count: int,
    *,
    degree: int = 0,
    size: float = 0.06,
    logits: tuple[float, float] = (-3.0, 4.0),
    radius: float = 1.0,
) -> FlatGaussians:
    """Gaussians of random orientation in a ball of ``radius``; some harmonics drive colors below zero."""
    basis = (degree + 1) ** 2
    return FlatGaussians(
        means_world=f32(radius * unit(rng.normal(size=(count, 3))) * rng.random((count, 1)) ** (1 / 3)),
        quats_wxyz=f32(rng.normal(size=(count, 4)) * np.exp(rng.normal(size=(count, 1)))),
        log_scales=f32(np.log(size) + rng.normal(size=(count, 2)) * 0.5),
        opacity_logits=f32(rng.uniform(*logits, count)),
        sh=f32(rng.normal(size=(count, basis, 3)) * (0.8 / basis)),
    )


def in_plane(rng: np.random.Generator, count: int, *, z: float = 0.0, size: float = 0.2) -> FlatGaussians:
    """Gaussians that all lie in one plane of constant z: (a, b, -a, b) turns the normal exactly to z."""
    angle = rng.uniform(-np.pi, np.pi, count)
    a, b = np.cos(angle), np.sin(angle)
    flat = make_cloud(rng, count, size=size)
    flat.quats_wxyz = f32(np.stack([a, b, -a, b], axis=-1))
    flat.means_world[:, 2] = z
    return flat


def facing_z(
    means_world: object, *, scales: object = 1.0, opacities: object = 0.5, rgb_srgb: object = 0.5
) -> FlatGaussians:
    """Gaussians whose normal is z and whose axes r2, r3 are y and -x, of degree 0."""
    means = f32(means_world).reshape(-1, 3)
    count = len(means)
    a = np.broadcast_to(np.asarray(opacities, np.float64), (count,))
    return FlatGaussians(
        means_world=means,
        quats_wxyz=f32(np.tile([1.0, 0.0, -1.0, 0.0], (count, 1))),
        log_scales=f32(np.log(np.broadcast_to(np.asarray(scales, np.float64), (count, 2)))),
        opacity_logits=f32(np.log(a / (1 - a))),
        sh=f32((np.broadcast_to(np.asarray(rgb_srgb, np.float64), (count, 3)) - 0.5) / 0.28209479177387814)[
            :, None, :
        ],
    )


def rays_inwards(
    rng: np.random.Generator,
    count: int,
    *,
    distance: float = 3.0,
    spread: float = 0.8,
    t_min: np.ndarray | float = 0.0,
    t_max: np.ndarray | float = np.inf,
) -> RayBatch:
    """Rays from a sphere around the origin to random points near it."""
    origins = f32(unit(rng.normal(size=(count, 3))) * distance)
    directions = f32(unit(rng.normal(size=(count, 3)) * spread * 0.5 - origins))
    return RayBatch(origins, directions, t_min, t_max)


def make_tracer(gaussians: FlatGaussians, features: np.ndarray | None = None, **options: object) -> CpuTracer:
    settings = TraceSettings(**{k: options.pop(k) for k in list(options) if k in TraceSettings.model_fields})
    tracer = CpuTracer(settings, packet_mode=PACKETS[0], **options)
    tracer.build(gaussians, features)
    return tracer


def hit_lists(seen: TraceResult) -> list[list[int]]:
    """Ids of the Gaussians of each ray of a recorded trace."""
    assert seen.recording is not None
    return [seen.recording.ids_of_ray(ray).tolist() for ray in range(len(seen.hit_counts))]


def relative_error(found: np.ndarray, expected: np.ndarray) -> float:
    """Largest difference over the largest expected magnitude."""
    if expected.size == 0:
        return 0.0
    return float(np.abs(found - expected).max() / max(np.abs(expected).max(), 1e-12))


def random_gradients(rng: np.random.Generator, rays: int, features: int = 0) -> TraceGradients:
    return TraceGradients(
        rgb_srgb=f32(rng.normal(size=(rays, 3))),
        transmittance=f32(rng.normal(size=rays)),
        depth_sum=f32(rng.normal(size=rays)),
        depth_median=f32(rng.normal(size=rays)),
        normal_world=f32(rng.normal(size=(rays, 3))),
        features=f32(rng.normal(size=(rays, features))),
        ray_errors=f32(rng.random(rays)),
    )


def reference_loss(result: ReferenceResult, gradients: TraceGradients) -> torch.Tensor:
    """The scalar whose gradients by the outputs are ``gradients``."""
    loss = torch.zeros((), dtype=torch.float64)
    for name in OUTPUTS:
        given = getattr(gradients, name)
        if given is not None:
            loss = loss + (getattr(result, name) * torch.tensor(given, dtype=torch.float64)).sum()
    return loss


def reference_gradients(
    parameters: ReferenceParameters, result: ReferenceResult, gradients: TraceGradients
) -> dict[str, np.ndarray]:
    leaves = [getattr(parameters, name) for name in PARAMETERS]
    found = torch.autograd.grad(reference_loss(result, gradients), leaves, allow_unused=True)
    return {
        name: np.zeros(leaf.shape) if g is None else g.numpy()
        for name, leaf, g in zip(PARAMETERS, leaves, found, strict=True)
    }


def scattered(gradients: GaussianGradients, count: int) -> dict[str, np.ndarray]:
    """Gradients of all Gaussians, zero where none was hit."""
    dense = {}
    for name in PARAMETERS:
        rows = getattr(gradients, name)
        dense[name] = np.zeros((count, *rows.shape[1:]))
        dense[name][gradients.ids] = rows
    return dense


def same_bits(a: object, b: object) -> None:
    """Both results hold the same bytes in every array."""
    for field in fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if isinstance(x, np.ndarray):
            assert x.dtype == y.dtype and x.shape == y.shape, field.name
            assert x.tobytes() == y.tobytes(), field.name


def reference_in_chunks(
    gaussians: FlatGaussians,
    rays: RayBatch,
    settings: TraceSettings,
    features: np.ndarray | None = None,
    given: TraceGradients | None = None,
    rays_at_once: int = 25,
) -> tuple[list[list[int]], dict[str, np.ndarray], dict[str, np.ndarray]]:
    """The twin's hit lists, outputs and gradients, a few rays at a time so that memory stays small."""
    ids: list[list[int]] = []
    values: dict[str, list[np.ndarray]] = {name: [] for name in OUTPUTS}
    total: dict[str, np.ndarray] = {}
    parameters = ReferenceParameters.from_gaussians(gaussians, features)
    for start in range(0, len(rays), rays_at_once):
        rows = slice(start, start + rays_at_once)
        result = trace_reference(parameters, rays[rows], settings)
        ids += [row.tolist() for row in result.hit_ids]
        for name in OUTPUTS:
            values[name].append(getattr(result, name).detach().numpy())
        if given is not None:
            part = TraceGradients(**{name: getattr(given, name)[rows] for name in OUTPUTS})
            for name, gradient in reference_gradients(parameters, result, part).items():
                total[name] = total.get(name, 0.0) + gradient
    return ids, {name: np.concatenate(parts) for name, parts in values.items()}, total


def assert_matches_reference(
    gaussians: FlatGaussians,
    rays: RayBatch,
    *,
    features: np.ndarray | None = None,
    seed: int = 0,
    value_tolerance: float = VALUE_TOLERANCE,
    gradient_tolerance: float = GRADIENT_TOLERANCE,
    **options: object,
) -> tuple[TraceResult, dict[str, np.ndarray]]:
    """Hit lists equal to the twin's; values and gradients within the tolerances. Returns ours."""
    tracer = make_tracer(gaussians, features, **options)
    ours = tracer.trace(rays, record=True)
    given = random_gradients(np.random.default_rng(seed), len(rays), ours.features.shape[1])
    ids, values, expected = reference_in_chunks(gaussians, rays, tracer.settings, features, given)
    assert ours.recording is not None
    assert hit_lists(ours) == ids
    assert ours.hit_counts.tolist() == [len(row) for row in ids]
    for name in OUTPUTS:
        error = relative_error(getattr(ours, name), values[name])
        assert error < value_tolerance, f"{name}: {error:.2e}"
    found = scattered(tracer.backward(ours.recording, given), len(gaussians))
    for name in PARAMETERS:
        error = relative_error(found[name], expected[name])
        assert error < gradient_tolerance, f"gradient of {name}: {error:.2e}"
    return ours, found
