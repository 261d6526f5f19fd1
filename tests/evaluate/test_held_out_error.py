"""The causes of the held-out error: known answers for a wall, and a run of generated photographs."""

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.held_out_error import ROWS, main, table
from benchmarks.view_colors import fitted_colors_picture, nearest_directions, with_frozen_colors
from octasplat import reconstruct
from octasplat.engine.core.psnr import psnr
from octasplat.engine.evaluate.view_support import GROUP_NAMES, Support, gain_if_covered, group_errors, sees
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians
from octasplat.engine.gaussians.spherical_harmonics import sh_basis
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.engine.render.renderer import render_rays
from octasplat.engine.trace.cpu.tracer import CpuTracer
from octasplat.engine.trace.protocol import TraceSettings
from tests.support.small_run import RUN_OPTIONS
from tests.support.tiny_dataset import make_tiny_dataset

BLACK = np.zeros(3, np.float32)


def wall(depth: float = 2.0, cells: int = 24) -> FlatGaussians:
    """Opaque Gaussians side by side across z = depth, normals along z, all of one gray."""
    across = np.linspace(-1.5, 1.5, cells)
    x, y = (a.reshape(-1) for a in np.meshgrid(across, across))
    count, half = len(x), float(np.sqrt(0.5))
    return FlatGaussians(
        means_world=np.stack([x, y, np.full(count, depth)], axis=1).astype(np.float32),
        quats_wxyz=np.tile(np.array([half, 0, -half, 0], np.float32), (count, 1)),
        log_scales=np.full((count, 2), np.log(0.1), np.float32),
        opacity_logits=np.full(count, 4.0, np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
    )


def built(gaussians: FlatGaussians) -> CpuTracer:
    tracer = CpuTracer(TraceSettings(), threads=1)
    tracer.build(gaussians)
    return tracer


def test_colors_are_frozen_at_the_nearest_camera():
    cameras = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    mean = np.array([[0.0, 0.0, 2.0]], np.float32)
    # seen from x = 0.5 the camera at 0 stands nearer, seen from x = 1.8 the other one
    np.testing.assert_allclose(nearest_directions(mean, np.array([0.5, 0, 0]), cameras), [[0, 0, 1]])
    far = nearest_directions(mean, np.array([1.8, 0, 0]), cameras)
    np.testing.assert_allclose(far, [[-np.sqrt(0.5), 0, np.sqrt(0.5)]])
    sh = np.random.default_rng(0).normal(0, 0.1, (1, 9, 3)).astype(np.float32)
    one = replace(wall(cells=1), means_world=mean, sh=sh)
    frozen = with_frozen_colors(one, far)
    wanted = 0.5 + np.einsum("nk,nkc->nc", sh_basis(far, 2), sh)
    np.testing.assert_allclose(frozen.base_rgb_srgb, wanted, atol=1e-6)
    assert frozen.sh_degree == 0


def test_fitted_colors_repair_colors_and_no_geometry():
    scene, camera = wall(), PinholeCamera.from_pose(np.eye(4), 48, 36, fy_px=40.0)
    rng = np.random.default_rng(1)
    colors = (rng.uniform(-0.3, 0.3, (len(scene), 1, 3)) / SH_C0).astype(np.float32)
    tracer, rays = built(scene), camera.rays()
    render = render_rays(tracer, rays, BLACK).rgb_srgb
    painted = render_rays(built(replace(scene, sh=colors)), rays, BLACK).rgb_srgb
    weight = np.ones(render.shape[:2], np.float32)
    fitted, left_out = fitted_colors_picture(tracer, scene, rays, render, painted, weight)
    assert left_out.mean() == pytest.approx(0.5)
    assert psnr(fitted, painted, weight * left_out) > psnr(render, painted, weight * left_out) + 5
    # an error that no neighbouring pixel knows of stays
    noise = np.clip(render + rng.normal(0, 0.1, render.shape), 0, 1).astype(np.float32)
    refitted, left_out = fitted_colors_picture(tracer, scene, rays, render, noise, weight)
    assert psnr(refitted, noise, weight * left_out) < psnr(render, noise, weight * left_out) + 0.5


def test_a_wall_hides_what_is_behind_it():
    tracer = built(wall(2.0))
    points = np.array([[0.0, 0.0, 1.9], [0.05, 0.05, 3.0], [0.0, 0.0, 2.0]])
    assert sees(tracer, np.zeros(3), points).tolist() == [True, False, True]


def test_errors_are_grouped_by_views():
    support = Support(np.arange(5), np.array([-1, 0, 2, 2, 40]), np.array([0.5, 0.1, 0.01, 0.03, 0.01]))
    found = group_errors([support])
    assert set(found) == {"nothing met", "0", "2", GROUP_NAMES[-1]}
    assert found["2"]["pixels"] == pytest.approx(0.4)
    assert found["2"]["psnr"] == pytest.approx(-10 * np.log10(0.02))
    assert found["0"]["error"] == pytest.approx(0.1 / 0.65)
    # 0.1, 0.01 and 0.03 would be 0.01 like what many views see; what meets nothing keeps its 0.5
    assert gain_if_covered(found) == pytest.approx(10 * np.log10(0.65 / 0.54))
    assert gain_if_covered({name: found[name] for name in ("0", "2")}) is None


@pytest.mark.heavy
def test_a_run_is_analysed(tmp_path_factory, tmp_path, capsys):
    scene = make_tiny_dataset(tmp_path_factory)
    run = tmp_path / "run"
    reconstruct(scene, run, **RUN_OPTIONS)
    main([str(run), "--json", str(tmp_path / "found.json"), "--threads", "1", "--stride", "4"])
    shown = capsys.readouterr().out
    (found,) = json.loads((tmp_path / "found.json").read_text())
    mean = found["held_out"]["mean"]
    measured = json.loads((run / "metrics.json").read_text())["mean"]["psnr"]
    assert mean["psnr"] == pytest.approx(measured, abs=0.02)
    # a fit never makes a picture worse, and one with more freedom is no worse than one with less
    for less, more in [
        ("psnr", "gain_and_offset"), ("gain_and_offset", "affine_color"), ("psnr", "local_gain"),
        ("psnr", "shift"), ("psnr", "local_motion"), ("local_gain", "color_and_motion"),
    ]:  # fmt: skip
        assert mean[less] <= mean[more] + 0.02
    assert mean["degree_0"] == pytest.approx(mean["psnr"], abs=0.01)  # the run has no harmonics
    assert sum(group["pixels"] for group in found["coverage"].values()) == pytest.approx(1)
    assert all(title in shown for title in ROWS.values())
    assert table([found]).splitlines()[0] in shown
