"""``octasplat relight`` on a file of Gaussians with materials."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.operations.relight import RelightOptions
from octasplat.engine.pathtracing.environment import EnvironmentMap, environment_frame
from octasplat.engine.pathtracing.relighting import split_sum_relighter
from octasplat.engine.render.environment_files import write_environment
from octasplat.engine.render.image_files import read_image
from octasplat.engine.shading.material_settings import MaterialSettings
from octasplat.engine.trace.protocol import TraceSettings
from octasplat.workers.cli.main import cli
from tests.support.daily import some_daily
from tests.support.image_channels import read_channels
from tests.support.light_scenes import camera, psnr, shiny_ball

SMALL = ("--turntable", "--frames", 2, "--width", 32, "--height", 24, "--threads", 2, "--samples", 16)


def relight(*arguments: object) -> Result:
    return CliRunner().invoke(cli, ["relight", *(str(argument) for argument in arguments)])


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball of smooth metal, and maps: white, and red before blue behind."""
    folder = tmp_path_factory.mktemp("scene")
    gaussians = shiny_ball(800, 1.0, albedo=(1.0, 1.0, 1.0), metallic=1.0, roughness=0.1)
    write_gaussian_ply(gaussians, folder / "ball.ply")
    write_gaussian_ply(gaussians.without_channels(["albedo"]), folder / "plain.ply")
    write_environment(folder / "white.hdr", np.full((16, 32, 3), 0.5, np.float32))
    sides = np.zeros((16, 32, 3), np.float32)
    sides[:, 8:24, 0], sides[:, :8, 2], sides[:, 24:, 2] = 0.5, 0.5, 0.5
    write_environment(folder / "sides.exr", sides)
    write_environment(folder / "turned.exr", np.roll(sides, 16, axis=1))
    return folder


@pytest.mark.parametrize("by", some_daily(["split-sum", "path"], ["path"]))
def test_white_furnace_of_white_metal(scene, tmp_path, by):
    done = relight(
        scene / "ball.ply",
        "--environment",
        scene / "white.hdr",
        "-o",
        tmp_path,
        "--exr",
        "--integrator",
        by,
        *SMALL,
    )
    assert done.exit_code == 0, done.output
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frame_0000.exr", "frame_0001.exr"]
    image = read_channels(tmp_path / "frame_0000.exr")
    inside = np.s_[9:15, 13:19]
    assert image["A"][inside].mean() > 0.98 and image["A"][0, 0] == 0
    assert image["R"][inside].mean() == pytest.approx(0.5, rel=0.03)


@pytest.mark.parametrize("recipe", ["split_sum", "near_field", "ref_gaussian"])
def test_white_mirror_shows_the_radiance_around_it_by_each_recipe(recipe, monkeypatch):
    monkeypatch.setattr(split_sum_relighter, "ENVIRONMENT_HEIGHT_PX", 16)
    ball = shiny_ball(400, 0.4, albedo=(1, 1, 1), metallic=1.0, roughness=0.1)
    # rays begin so far off the coarse ball that it does not hide the environment from itself
    relighter = split_sum_relighter.SplitSumRelighter(
        ball, TraceSettings(), MaterialSettings(recipe=recipe, ray_bias=0.1), extent_world=1, threads=1
    )
    view = camera((0, 0, -2), (0, 0, 0), (4, 4), 5).rays()
    for radiance in (0.25, 4.0):
        around = np.full((8, 16, 3), radiance, np.float32)
        relighter.set_environment(EnvironmentMap(around, environment_frame(np.array([0.0, -1.0, 0.0]))))
        np.testing.assert_allclose(relighter.render(view).linear, radiance, rtol=0.02)


@pytest.mark.exhaustive
def test_several_environments_have_folders_and_a_film(scene, tmp_path):
    maps = ("--environment", scene / "sides.exr", "--environment", scene / "white.hdr")
    done = relight(scene / "ball.ply", *maps, "-o", tmp_path / "out", *SMALL, "--background", "environment")
    assert done.exit_code == 0, done.output
    names = sorted(str(path.relative_to(tmp_path / "out")) for path in (tmp_path / "out").rglob("*.png"))
    assert names == [f"{light}/frame_000{k}.png" for light in ("sides", "white") for k in (0, 1)]
    behind = read_image(tmp_path / "out" / "white" / "frame_0000.png")[0, 0]
    assert behind == pytest.approx(float(linear_to_srgb(np.array(0.5))), abs=1 / 255)
    done = relight(scene / "ball.ply", *maps, "-o", tmp_path / "film.mp4", *SMALL, "--spin")
    assert done.exit_code == 0, done.output
    assert (tmp_path / "film.mp4").stat().st_size > 500


@pytest.mark.exhaustive
def test_relight_clamp_limits_radiance(scene, tmp_path):
    """White metal in light of 0.5, or of what is left of it."""
    for most, left in ((0.2, 0.2), (3, 0.5)):
        done = relight(
            scene / "ball.ply", "--environment", scene / "white.hdr", "-o", tmp_path / str(most), "--exr",
            "--clamp", most, *SMALL,
        )  # fmt: skip
        assert done.exit_code == 0, done.output
        image = read_channels(tmp_path / str(most) / "frame_0000.exr")
        assert image["G"][9:15, 13:19].mean() == pytest.approx(left, rel=0.03)


def test_options_of_the_other_integrator_are_named() -> None:
    options = {"environments": ("a.hdr",), "max_bounces": 3}
    [sentence] = RelightOptions.model_validate(options).unused()
    assert "max_bounces" in sentence
    assert RelightOptions.model_validate({**options, "integrator": "path"}).unused() == ()


@pytest.mark.parametrize(("by", "least"), some_daily([("split-sum", 60), ("path", 25)], {("path", 25)}))
def test_relight_rotated_environment_equals_rotated_map(scene, tmp_path, by, least):
    for name, environment, turn in (("a", "turned.exr", 0), ("b", "sides.exr", 180), ("c", "sides.exr", 0)):
        done = relight(
            scene / "ball.ply", "--environment", scene / environment, "--rotation", turn,
            "-o", tmp_path / name, "--integrator", by, *SMALL,
        )  # fmt: skip
        assert done.exit_code == 0, done.output
    a, b, c = (read_image(tmp_path / name / "frame_0000.png") for name in "abc")
    assert psnr(a, b) > least and psnr(a, c) < 20


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("plain.ply", "white.hdr"), "plain.ply has no materials"),
        (("ball.ply", "ball.ply"), "HDR or EXR"),
        (("ball.ply", "missing.hdr"), "missing.hdr"),
        (("ball.ply", "text.hdr"), "text.hdr: the environment cannot be read"),
        (("ball.ply", "cut.hdr"), "cut.hdr is damaged"),
        (("ball.ply", "white.hdr", "other/white.exr"), "two environments"),
    ],
)
def test_relight_unusable_input_is_refused(scene, tmp_path, arguments, told):
    (scene / "other").mkdir(exist_ok=True)
    write_environment(scene / "other" / "white.exr", np.full((16, 32, 3), 0.5, np.float32))
    (scene / "text.hdr").write_text("no picture")
    (scene / "cut.hdr").write_bytes((scene / "white.hdr").read_bytes()[:-40])
    maps = [part for name in arguments[1:] for part in ("--environment", scene / name)]
    done = relight(scene / arguments[0], *maps, "-o", tmp_path / "out", *SMALL)
    assert done.exit_code == 1
    assert done.stderr.count("\n") == 1 and told in done.stderr
    assert not (tmp_path / "out").exists()
