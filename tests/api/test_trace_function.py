"""The tracer as a function of torch, against autograd of the reference implementation."""

from pathlib import Path

import numpy as np
import pytest
import torch

import octasplat as osp
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.scene_metadata import SceneMetadata
from octasplat.engine.trace.reference import ReferenceParameters, ReferenceResult, trace_reference
from tests.support.trace_scenes import make_cloud, rays_inwards, relative_error

NAMES = {
    "means": "means_world",
    "quats": "quats_wxyz",
    "log_scales": "log_scales",
    "opacity_logits": "opacity_logits",
    "sh": "sh",
}


def tensors_and_rays(count: int, rays: int) -> tuple[osp.GaussianTensors, osp.Rays, RayBatch]:
    rng = np.random.default_rng(5)
    scene = osp.Scene(make_cloud(rng, count, degree=2, size=0.25))
    batch = rays_inwards(rng, rays)
    lines = osp.Rays(torch.tensor(batch.origins_world), torch.tensor(batch.directions_world))
    return osp.GaussianTensors.of(scene), lines, batch


def weights(rays: int) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(8).normal(size=(rays, 9)))


def loss_of(
    rgb: torch.Tensor, alpha: torch.Tensor, depth: torch.Tensor, median: torch.Tensor, normal: torch.Tensor
) -> torch.Tensor:
    parts = torch.cat([rgb, alpha[:, None], depth[:, None], median[:, None], normal], dim=1).double()
    return (parts * weights(len(rgb))).sum()


def reference_loss_of(result: ReferenceResult) -> torch.Tensor:
    alpha = 1 - result.transmittance
    met = alpha > 1e-8
    depth = torch.where(met, result.depth_sum / torch.where(met, alpha, 1.0), 0.0)
    return loss_of(result.rgb_srgb, alpha, depth, result.depth_median, result.normal_world)


def test_values_and_gradients_by_parameters_are_those_of_the_reference() -> None:
    parameters, lines, batch = tensors_and_rays(30, 80)
    seen = osp.trace(parameters, lines)
    ours = loss_of(seen.rgb, seen.alpha, seen.depth, seen.depth_median, seen.normal)
    ours.backward()

    reference = ReferenceParameters.from_gaussians(parameters.scene().gaussians)
    result = trace_reference(reference, batch, osp.TraceSettings())
    expected = reference_loss_of(result)
    expected.backward()
    assert ours.item() == pytest.approx(expected.item(), rel=1e-4)
    assert relative_error(seen.rgb.detach().numpy(), result.rgb_srgb.detach().numpy()) < 1e-5
    for name, of_reference in NAMES.items():
        found, right = getattr(parameters, name).grad, getattr(reference, of_reference).grad
        assert found.abs().max() > 0
        assert relative_error(found.numpy(), right.numpy()) < 1e-4, name


@pytest.mark.parametrize("name", ["origins", "directions"])
def test_gradients_by_rays_are_differences_of_the_loss(name: str) -> None:
    parameters, lines, _ = tensors_and_rays(8, 60)
    lines.directions = 2.5 * lines.directions  # of any length
    getattr(lines, name).requires_grad_()
    seen = osp.trace(parameters, lines)
    loss_of(seen.rgb, seen.alpha, seen.depth, seen.depth_median, seen.normal).backward()
    found = getattr(lines, name).grad
    assert found is not None
    reference = ReferenceParameters.from_gaussians(parameters.scene().gaussians)
    step, expected = 1e-3, np.zeros((60, 3))
    for axis in range(3):
        losses = []
        for sign in (1, -1):
            moved = getattr(lines, name).detach().clone()
            moved[:, axis] += sign * step
            rays = {"origins": lines.origins, "directions": lines.directions, name: moved}
            ways = torch.nn.functional.normalize(rays["directions"].detach(), dim=1)
            batch = RayBatch(rays["origins"].detach().numpy(), ways.numpy())
            with torch.no_grad():
                result = trace_reference(reference, batch, osp.TraceSettings())
                alpha = 1 - result.transmittance
                depth = torch.where(alpha > 1e-8, result.depth_sum / alpha.clamp(min=1e-8), 0.0)
                parts = [result.rgb_srgb, alpha[:, None], depth[:, None], result.depth_median[:, None]]
                rows = torch.cat([*parts, result.normal_world], dim=1)
                losses.append((rows * weights(60)).sum(dim=1).numpy())
        expected[:, axis] = (losses[0] - losses[1]) / (2 * step)
    errors = np.abs(found.numpy() - expected).max(axis=1) / np.abs(expected).max()
    # A few steps cross an octagon's edge, behind which there is no slope.
    assert np.mean(errors < 5e-3) > 0.9, np.sort(errors)


def test_pending_traces_are_independent() -> None:
    parameters, lines, _ = tensors_and_rays(20, 40)
    first, second = osp.trace(parameters, lines), osp.trace(parameters, lines[:10])
    (first.rgb.sum() + 0 * second.rgb.sum()).backward()
    together = parameters.sh.grad
    parameters.sh.grad = None
    osp.trace(parameters, lines).rgb.sum().backward()
    torch.testing.assert_close(together, parameters.sh.grad)


def test_parameters_changed_before_backward_are_refused() -> None:
    parameters, lines, _ = tensors_and_rays(20, 40)
    seen = osp.trace(parameters, lines)
    with torch.no_grad():
        parameters.means += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        seen.rgb.sum().backward()


def test_features_are_composited_like_colors() -> None:
    parameters, lines, _ = tensors_and_rays(20, 40)
    parameters.features = torch.ones(20, 2, requires_grad=True)
    seen = osp.trace(parameters, lines)
    torch.testing.assert_close(seen.features[:, 0], seen.alpha, atol=1e-5, rtol=1e-5)
    seen.features.sum().backward()
    assert parameters.features.grad is not None
    torch.testing.assert_close(parameters.features.grad[:, 0].sum(), seen.alpha.sum(), atol=1e-3, rtol=1e-4)


def test_double_precision_leaves_get_gradients_of_their_own_type() -> None:
    parameters, lines, _ = tensors_and_rays(20, 40)
    means = parameters.means.detach().double().requires_grad_()
    parameters.means = means
    osp.trace(parameters, lines).alpha.sum().backward()
    assert means.grad is not None and means.grad.dtype == torch.float64


def test_camera_optimisation_recovers_pose() -> None:
    """Gradients by rays find a camera: the smallest use of them."""
    scene = osp.Scene(make_cloud(np.random.default_rng(5), 200, size=0.3))
    camera = osp.Camera.looking_at((0, 0, -3), (0, 0, 0), 24, 24)
    rays = osp.Rays.of(camera)
    target = osp.trace(scene, rays).rgb
    shift = torch.tensor([[0.05, -0.04, 0.0]], requires_grad=True)
    optimizer = torch.optim.Adam([shift], lr=5e-3)
    for _ in range(60):
        optimizer.zero_grad()
        seen = osp.trace(scene, osp.Rays(rays.origins + shift, rays.directions))
        ((seen.rgb - target) ** 2).mean().backward()
        optimizer.step()
    assert shift.detach().norm() < 0.01


def test_rays_indexed_by_int_give_one_ray() -> None:
    scene = osp.Scene(make_cloud(np.random.default_rng(3), 40))
    rays = osp.Rays.of(scene.camera(12, 8))
    everything = osp.trace(scene, rays)
    for number in (45, -1, np.int64(45), torch.tensor(7)):
        assert rays[number].directions.shape == (1, 3)
        torch.testing.assert_close(osp.trace(scene, rays[number]).rgb[0], everything.rgb[number])


def test_scene_tensors_keep_metadata(scene_file: Path) -> None:
    scene = osp.Scene(osp.load(scene_file).gaussians, SceneMetadata(turned_beyond=0.5, near_world=0.1))
    tensors = osp.GaussianTensors.of(scene)
    assert tensors.scene().facts == scene.facts
    camera = scene.camera(width_px=48, height_px=32)
    expected, found = osp.trace(scene, camera), osp.trace(tensors, camera)
    unturned = osp.trace(osp.Scene(scene.gaussians), camera)
    assert not torch.equal(expected.normal, unturned.normal)  # so that it matters
    assert torch.equal(found.normal, expected.normal)


GOOD: dict[str, tuple[int, ...]] = {
    "means": (4, 3), "quats": (4, 4), "log_scales": (4, 2), "opacity_logits": (4,), "sh": (4, 4, 3),
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("means", (4, 4)),
        ("quats", (5, 4)),
        ("quats", (3, 4)),
        ("log_scales", (4, 3)),  # as in 3DGS
        ("opacity_logits", (4, 1)),
        ("sh", (4, 3)),
        ("sh", (4, 5, 3)),
        ("sh", (3, 4, 3)),
        ("features", (3, 2)),
        ("features", (4,)),
        ("directions", (5, 2)),
        ("directions", (3,)),
        ("origins", (4, 3)),
        ("origins", (3,)),
        ("origins", (0, 3)),
    ],
)
def test_tensors_of_other_shapes_are_refused_by_name(name: str, shape: tuple[int, ...]) -> None:
    """The kernels would read beyond them, or other numbers than are meant."""
    shapes = {**GOOD, "directions": (5, 3), "origins": (1, 3), name: shape}
    tensors = {each: torch.ones(*size) for each, size in shapes.items()}
    rays = osp.Rays(tensors.pop("origins"), tensors.pop("directions"))
    with pytest.raises(osp.ConfigError, match=f"^{name}: has "):
        osp.trace(osp.GaussianTensors(**tensors), rays)


def test_what_is_no_scene_and_no_rays_is_refused(scene_file: Path) -> None:
    scene = osp.load(scene_file)
    with pytest.raises(TypeError, match="trace takes Rays or one camera, not tuple"):
        osp.trace(scene, scene.turntable(2))  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="trace takes a Scene or GaussianTensors, not PosixPath"):
        osp.trace(scene_file, scene.camera(8, 6))  # type: ignore[arg-type]
    with pytest.raises(osp.ConfigError, match=r"^directions: must be a tensor of torch, not ndarray"):
        osp.trace(scene, osp.Rays(torch.zeros(1, 3), np.ones((5, 3))))  # type: ignore[arg-type]
