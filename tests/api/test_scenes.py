"""Scenes in memory: parameters, files and pictures."""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import octasplat as osp
from octasplat.engine.gaussians.scene_metadata import SceneMetadata


def test_arrays_are_views_of_the_scene(scene_file: Path) -> None:
    scene = osp.load(scene_file)
    before = scene.means.copy()
    scene.means += np.float32([1, 2, 3])
    scene.scales = 2 * scene.scales
    scene.opacities = np.full(len(scene), 0.25)
    np.testing.assert_array_equal(scene.gaussians.means_world, before + np.float32([1, 2, 3]))
    np.testing.assert_allclose(scene.scales, np.exp(scene.log_scales))
    np.testing.assert_allclose(scene.opacities, 0.25, rtol=1e-6)
    assert not np.allclose(scene.copy().means, before)


def test_logarithms_and_logits_are_changed_in_place(scene_file: Path) -> None:
    scene = osp.load(scene_file)
    before = scene.copy()
    scene.log_scales += np.float32(0.5)
    scene.opacity_logits = scene.opacity_logits - 1
    np.testing.assert_allclose(scene.log_scales, before.log_scales + 0.5, rtol=1e-6)
    np.testing.assert_allclose(scene.gaussians.opacity_logits, before.opacity_logits - 1, rtol=1e-6)
    with pytest.raises(osp.ConfigError, match="log_scales: must be finite"):
        scene.log_scales = np.full((len(scene), 2), np.inf)
    with pytest.raises(osp.ConfigError, match="opacity_logits: has the shape"):
        scene.opacity_logits = np.zeros(3)


def test_arrays_of_another_shape_are_refused(scene_file: Path) -> None:
    scene = osp.load(scene_file)
    before = scene.copy()
    for name in ("means", "quats", "scales", "opacities"):
        with pytest.raises(osp.ConfigError, match=f"{name}: has the shape"):
            setattr(scene, name, getattr(scene, name)[:1])
        np.testing.assert_array_equal(getattr(scene, name), getattr(before, name))
    with pytest.raises(osp.ConfigError, match="sh: has the shape"):
        scene.sh = scene.sh[:, :2]
    with pytest.raises(osp.ConfigError, match="quats: has the shape"):
        osp.Scene.from_arrays(before.means, before.quats[:1], before.scales, before.opacities, before.sh)


def test_harmonics_of_another_degree_can_be_assigned(scene_file: Path) -> None:
    scene = osp.load(scene_file)
    constant = scene.sh[:, :1].copy()
    scene.sh = scene.sh[:, :1]
    assert scene.sh_degree == 0
    np.testing.assert_array_equal(scene.sh, constant)


def test_values_out_of_range_are_refused_and_opaque_ones_are_finite(scene_file: Path) -> None:
    scene = osp.load(scene_file)
    out_of_range = [("scales", 0.0), ("opacities", 1.1), ("opacities", np.nan), ("quats", 0.0)]
    for name, value in [*out_of_range, ("means", np.nan), ("sh", np.inf)]:
        with pytest.raises(osp.ConfigError, match=f"{name}: must be"):
            setattr(scene, name, np.full_like(getattr(scene, name), value))
    scene.opacities = np.linspace(0, 1, len(scene))
    assert np.isfinite(scene.opacity_logits).all()
    np.testing.assert_allclose(scene.opacities, np.linspace(0, 1, len(scene)), atol=1e-6)


def test_what_is_no_picture_is_refused(scene_file: Path) -> None:
    scene = osp.load(scene_file)
    camera = scene.camera(16, 12)
    refused: tuple[dict[str, Any], ...] = (
        {"background": "grey"}, {"background": (2, 0, 0)}, {"background": 1}, {"shading": "lit"},
    )  # fmt: skip
    for options in refused:
        with pytest.raises(osp.ConfigError, match=f"^{next(iter(options))}: .* is neither"):
            osp.render(scene, camera, **options)
    np.testing.assert_allclose(osp.render(scene, camera, background=np.ones(3)).rgb[0, 0], 1)
    for place in ({"background": "grey"}, {"port": 1 << 16}):
        with pytest.raises(osp.ConfigError, match=f"^{next(iter(place))}: "):
            osp.view(scene, open_browser=False, **place)
    for size, fov in (((0, 12), 50.0), ((16, 12), 200.0), ((16, 12), 0.0)):
        with pytest.raises(osp.ConfigError, match=r"must be at least 1|between 0 and 180"):
            scene.camera(*size, fov_y_degrees=fov)
        with pytest.raises(osp.ConfigError, match=r"must be at least 1|between 0 and 180"):
            osp.Camera.looking_at((0, 0, -4), (0, 0, 0), *size, fov_y_degrees=fov)


@pytest.mark.parametrize("suffix", [".ply", ".spz", ".splat", ".glb"])
def test_scene_survives_every_format(scene_file: Path, tmp_path: Path, suffix: str) -> None:
    scene = osp.load(scene_file)
    again = osp.load(osp.save(scene, tmp_path / f"again{suffix}"))
    assert len(again) == len(scene)
    lows, highs = again.means.min(axis=0), again.means.max(axis=0)
    np.testing.assert_allclose([lows, highs], [scene.means.min(axis=0), scene.means.max(axis=0)], atol=0.01)


def test_save_to_lossy_format_logs_dropped_values(
    scene_file: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    with caplog.at_level(logging.INFO, logger="octasplat"):
        osp.save(osp.load(scene_file), tmp_path / "plain.splat")
    assert any("how colors change with the direction will be left out" in text for text in caplog.messages)
    assert capfd.readouterr() == ("", "")


def test_unknown_suffix_is_refused_with_a_sentence(scene_file: Path, tmp_path: Path) -> None:
    with pytest.raises(osp.OctasplatError, match=r"scene\.xyz"):
        osp.save(osp.load(scene_file), tmp_path / "scene.xyz")


def test_picture_shows_the_near_side_of_a_ball(scene_file: Path) -> None:
    scene = osp.load(scene_file)
    scene.opacities = np.full(len(scene), 0.99)
    scene.scales = np.full((len(scene), 2), 0.08)
    camera = osp.Camera.looking_at((0, 0, -4), (0, 0, 0), 65, 65, fov_y_degrees=40)
    image = osp.render(scene, camera, background=(0.0, 0.0, 1.0))
    middle, corner = (32, 32), (0, 0)
    assert image.alpha[middle] > 0.99 and image.alpha[corner] == 0
    assert image.depth[middle] == pytest.approx(3.0, abs=0.03) and image.depth[corner] == 0
    np.testing.assert_allclose(image.normal[middle], (0, 0, -1), atol=0.1)
    np.testing.assert_allclose(image.rgb[corner], (0, 0, 1))
    # The heaviest Gaussian lies where the pixel sees it.
    heaviest = image.gaussian[middle]
    np.testing.assert_allclose(scene.means[heaviest], (0, 0, -1), atol=0.15)
    assert image.gaussian[corner] == -1


def test_results_have_a_page_for_notebooks(scene_file: Path) -> None:
    scene = osp.load(scene_file)
    assert "1,200" in scene._repr_html_()
    image = osp.render(scene, scene.camera(width_px=32, height_px=24))
    assert image._repr_html_().startswith('<img src="data:image/png;base64,')
    assert image._repr_png_().startswith(b"\x89PNG")


def test_saved_pictures_are_read_back(scene_file: Path, tmp_path: Path) -> None:
    from octasplat.engine.render.image_files import read_image

    scene = osp.load(scene_file)
    image = osp.render(scene, scene.camera(width_px=32, height_px=24))
    found = read_image(image.save(tmp_path / "a.png"))
    np.testing.assert_allclose(found[..., :3], image.rgb, atol=0.5 / 255 + 1e-6)
    assert image.save(tmp_path / "a.exr").stat().st_size > 0


@pytest.mark.parametrize("name", ["view.hdr", "view", "view.gif"])
def test_pictures_of_other_formats_are_refused_by_name(scene_file: Path, tmp_path: Path, name: str) -> None:
    scene = osp.load(scene_file)
    image = osp.render(scene, scene.camera(width_px=12, height_px=8))
    with pytest.raises(osp.OctasplatError, match=r"view(\.\w+)?: .*\.png.*\.exr"):
        image.save(tmp_path / name)
    assert not (tmp_path / name).exists()


def test_scene_cameras_match_render_command(scene_file: Path, tmp_path: Path) -> None:
    whole = osp.load(scene_file)
    away = float(np.linalg.norm(whole.camera().centre_world))  # the ball has its middle at the origin
    scene = osp.Scene(whole.gaussians, SceneMetadata(near_world=away))
    osp.save(scene, tmp_path / "cut.ply")
    options = {"mode": "turntable", "frames": 1, "width_px": 48, "height_px": 36}
    osp.render(tmp_path / "cut.ply", tmp_path / "frames", **options)
    (frame,) = (tmp_path / "frames").rglob("*.png")
    shown = np.asarray(Image.open(frame).convert("RGB")) / 255
    loaded = osp.load(tmp_path / "cut.ply")
    np.testing.assert_allclose(osp.render(loaded, loaded.turntable(1, 48, 36)[0]).rgb, shown, atol=0.6 / 255)
    assert loaded.camera().near_world == pytest.approx(away)


def test_empty_scene_has_html_repr(scene_file: Path) -> None:
    scene = osp.load(scene_file)
    nothing = scene.select(scene.opacities > 2)
    assert len(nothing) == 0 and "harmonics" in nothing._repr_html_()


def test_one_number_selects_one_gaussian(scene_file: Path) -> None:
    scene = osp.load(scene_file)
    for index in (7, np.int64(7), [7], np.array([7]), slice(7, 8)):
        assert np.array_equal(scene.select(index).means, scene.means[7:8])
    assert len(scene.select(-1)) == 1 and len(scene.select([])) == 0
    mask = torch.tensor(scene.opacities > 0.5)
    assert len(scene.select(mask)) == int(mask.sum())  # type: ignore[arg-type]


def test_scene_of_tensors_with_gradients_is_that_of_their_values() -> None:
    """As they are after a training of one's own."""
    values = {
        "means": torch.randn(2, 3), "quats": torch.randn(2, 4), "scales": torch.rand(2, 2) + 0.1,
        "opacities": torch.rand(2), "sh": torch.randn(2, 4, 3),
    }  # fmt: skip
    trained = {name: tensor.clone().requires_grad_() for name, tensor in values.items()}
    scene = osp.Scene.from_arrays(**trained)
    assert np.array_equal(scene.means, values["means"].numpy())
    assert np.array_equal(scene.sh, values["sh"].numpy())
    scene.means = trained["means"] + 1
    assert np.allclose(scene.means, values["means"].numpy() + 1)


@pytest.mark.parametrize("channel", [np.zeros(2), np.zeros((3, 1)), 1.0])
def test_channels_of_another_shape_are_refused_by_name(channel: Any) -> None:
    arrays = {"means": np.zeros((2, 3)), "quats": np.ones((2, 4)), "scales": np.ones((2, 2))}
    with pytest.raises(osp.ConfigError, match=r"^channels: 'metallic' has the shape .*; it must be \(2, f\)"):
        osp.Scene.from_arrays(
            **arrays, opacities=np.ones(2), sh=np.zeros((2, 1, 3)), channels={"metallic": channel}
        )


@pytest.mark.parametrize("size", [(64.5, 48), (64.0, 48), ("64", 48), (64, None)])
def test_sizes_that_are_no_whole_numbers_are_refused(size: Any, scene_file: Path) -> None:
    scene = osp.load(scene_file)
    for camera in (lambda: scene.camera(*size), lambda: scene.turntable(2, *size)):
        with pytest.raises(osp.ConfigError, match=r"^(width|height)_px: must be a whole number of pixels \("):
            camera()
    camera = scene.camera(np.int64(8), np.int32(6))  # type: ignore[arg-type]
    assert osp.render(scene, camera).rgb.shape == (6, 8, 3)


def test_threads_below_zero_are_refused(scene_file: Path) -> None:
    scene = osp.load(scene_file)
    camera = scene.camera(16, 12)
    for call in (lambda: osp.render(scene, camera, threads=-1), lambda: osp.trace(scene, camera, threads=-1)):
        with pytest.raises(osp.ConfigError, match=r"^threads: must be 0"):
            call()


def test_threads_are_whole(scene_file: Path) -> None:
    scene = osp.load(scene_file)
    for threads in (1.5, "2"):
        with pytest.raises(osp.ConfigError, match="threads: must be"):
            osp.render(scene, scene.camera(width_px=8, height_px=8), threads=threads)  # type: ignore[call-overload]


def test_what_is_no_path_is_not_loaded(scene_file: Path) -> None:
    scene = osp.load(scene_file)
    with pytest.raises(TypeError, match=r"load takes the path of a file or run, not Scene\("):
        osp.load(scene)  # type: ignore[arg-type]


def test_residual_colors_are_taken_as_the_kernels_need_them() -> None:
    """Any array of numbers means its values; what is none is refused where it is given."""
    scene = osp.Scene.from_arrays(
        means=np.zeros((3, 3)),
        quats=np.tile([1.0, 0, 0, 0], (3, 1)),
        scales=np.ones((3, 2)),
        opacities=np.full(3, 0.5),
        sh=np.zeros((3, 1, 3)),
    )
    given = np.arange(36.0).reshape(3, 4, 3)
    scene.residual_sh = np.asfortranarray(given)
    assert scene.residual_sh is not None
    assert scene.residual_sh.dtype == np.float32 and scene.residual_sh.flags.c_contiguous
    np.testing.assert_array_equal(scene.select([2]).residual_sh, given[2:])
    for wrong in (given[:2], given[:, :2], given[:, :, :1], given[:, 0], np.full_like(given, np.nan)):
        with pytest.raises(osp.ConfigError, match="residual_sh"):
            scene.residual_sh = wrong
    scene.residual_sh = None
    assert scene.copy().residual_sh is None


def test_pictures_rays_and_tensors_are_equal_to_themselves_alone(scene_file: Path) -> None:
    scene = osp.load(scene_file).select([0, 1])
    camera = scene.camera(width_px=4, height_px=3)
    parameters, rays = osp.GaussianTensors.of(scene), osp.Rays.of(camera)
    traced, again = (osp.trace(parameters, rays, threads=1) for _ in range(2))
    pairs = [
        (osp.render(scene, camera, threads=1), osp.render(scene, camera, threads=1)),
        (rays, osp.Rays.of(camera)),
        (parameters, osp.GaussianTensors.of(scene)),
        (traced, again),
    ]
    for one, other in pairs:
        assert one == one and one != other and len({one, other}) == 2
