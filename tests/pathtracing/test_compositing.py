"""Layers for a compositor, which make the picture again, and noise taken away."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from octasplat.engine.core.color import linear_to_srgb, srgb_to_linear
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.pathtracing.compile_meshes import compile_meshes
from octasplat.engine.pathtracing.gaussian_layers import build_gaussian_layers
from octasplat.engine.pathtracing.path_tracer import PathTracer, PathTracerScene
from octasplat.engine.pathtracing.stage.materials import Diffuse, Glass, Mirror
from octasplat.engine.pathtracing.stage.model import Integrator, PointLight, RectangleLight, Stage, StageMesh
from octasplat.engine.render.environment_files import write_environment
from octasplat.engine.render.image_files import read_image
from octasplat.engine.trace.protocol import TraceSettings
from octasplat.workers.cli.main import cli
from tests.support.image_channels import read_channels
from tests.support.light_scenes import camera, film_of, psnr, table_with_a_box

COLOR = (0.9, 0.5, 0.2)
VIEW = camera((0.9, -1.0, -1.2), (0, -0.1, 0), (48, 36), 45)
LAMP = RectangleLight(
    position=(-1, -2, -1), direction=(1, 2, 1), width=0.5, height=0.5, radiance=20, visible=False
)
BALLS = tuple(
    StageMesh(shape="sphere", scale=0.15, position=(x, -0.15, z), material=material)
    for x, z, material in (
        (0.5, -0.3, Diffuse(color_srgb=(0.02, 0.02, 0.02))),
        (-0.4, -0.4, Glass()),
        (0.5, 0.4, Mirror()),
    )
)


def test_layers_recompose_image() -> None:
    numbers = Integrator(samples=16, max_depth=5, layers=True)
    lights = (LAMP, PointLight(position=(1, -1, 1), intensity=0.4, adds_light=True))
    stage = Stage(meshes=BALLS, lights=lights, integrator=numbers)

    def rendered(stage: Stage):  # type: ignore[no-untyped-def]
        layers = build_gaussian_layers(
            stage, table_with_a_box(), lambda path: pytest.fail(str(path)), Path(), TraceSettings(), size=1.0,
            threads=2,
        )  # fmt: skip
        scene = PathTracerScene(compile_meshes(stage, Path(), threads=2), layers, np.full(3, 0.2))
        return PathTracer(scene, stage.integrator, threads=2).render(VIEW.rays()).image()

    image = rendered(stage)
    found = {name: np.stack([image.layers[f"{name}.{c}"] for c in "RGB"], axis=-1) for name in
             ("background", "shadow", "things")}  # fmt: skip
    alpha = image.layers["things.A"][..., None]
    assert min(values.min() for values in image.layers.values()) >= 0.0 and alpha.max() <= 1.0
    again = found["background"] * found["shadow"] * (1 - alpha) + found["things"]
    assert psnr(again, image.rgb_linear) > 80
    plain = rendered(Stage(integrator=numbers.model_copy(update={"layers": False})))
    assert psnr(found["background"], plain.rgb_linear) > 80
    # Shadow beside the balls, light of the lamp that adds its own, and nothing of either far off.
    free = alpha[..., 0] == 0
    assert 0.05 < (alpha > 0.5).mean() < 0.5
    assert found["shadow"][free].min() < 0.7 and found["shadow"][free].max() > 1.05
    assert not found["things"][free].any() and (found["shadow"][0, 0] == 1).all()


def test_layers_have_standard_channel_names(tmp_path: Path) -> None:
    write_gaussian_ply(table_with_a_box(), tmp_path / "scene.ply")
    (tmp_path / "stage.toml").write_text(
        "[[meshes]]\nshape = 'sphere'\nscale = 0.2\nposition = [0.5, -0.2, 0.5]\n[integrator]\nsamples = 1\n"
    )
    common = ["--stage", str(tmp_path / "stage.toml"), "--turntable", "--frames", "2", "--width", "32"]
    render = ["render", str(tmp_path / "scene.ply"), *common, "--height", "24", "--layers", "-o"]
    done = CliRunner().invoke(cli, [*render, str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    channels = read_channels(tmp_path / "out" / "frame_0000.exr")
    parts = {f"{part}.{c}" for part in ("background", "shadow", "things") for c in "RGBA"}
    assert set(channels) == {"R", "G", "B", "A", *parts}
    refused = CliRunner().invoke(cli, [*render, str(tmp_path / "turn.mp4")])
    assert refused.exit_code == 1 and "holds no layers" in refused.output


def test_transparent_images_have_the_color_of_what_covers_them_at_edges() -> None:
    shining = StageMesh(
        shape="sphere", scale=0.4, material=Diffuse(color_srgb=(0, 0, 0), emission=0.4, emission_srgb=COLOR)
    )
    numbers = Integrator(samples=16, max_depth=1, exposure=1.0)
    film = film_of(Stage(meshes=(shining,), integrator=numbers), VIEW)
    image, opaque = film.image(exposure=1.0, transparent=True), film.image(exposure=1.0)
    edge = (image.alpha > 0.05) & (image.alpha < 0.95)
    assert edge.sum() > 20
    linear = 0.4 * srgb_to_linear(np.array(COLOR))
    straight = linear_to_srgb(2 * linear)
    np.testing.assert_allclose(image.rgb_srgb[edge], np.broadcast_to(straight, (edge.sum(), 3)), atol=1e-3)
    np.testing.assert_allclose(image.rgb_linear[edge], image.alpha[edge][:, None] * linear, rtol=1e-3)
    # Where nothing is seen of the background it is the picture itself.
    np.testing.assert_allclose(image.rgb_srgb[image.alpha == 1], opaque.rgb_srgb[image.alpha == 1], atol=1e-6)
    assert not image.rgb_srgb[image.alpha == 0].any()


def test_transparent_stage_of_gaussians_is_their_transparent_picture(tmp_path: Path) -> None:
    write_gaussian_ply(table_with_a_box(), tmp_path / "scene.ply")
    (tmp_path / "stage.toml").write_text(
        "[[gaussians]]\nlight = 'emissive'\n[integrator]\nsamples = 1\nanti_aliasing = false\n"
    )
    common = ["--camera", "0.9", "-1", "-1.2", "--width", "32", "--height", "24", "--threads", "1"]
    pictures = []
    for name, more in (("plain.png", []), ("staged.png", ["--stage", str(tmp_path / "stage.toml")])):
        command = ["render", str(tmp_path / "scene.ply"), *common, "--background", "transparent", *more]
        done = CliRunner().invoke(cli, [*command, "-o", str(tmp_path / name)])
        assert done.exit_code == 0, done.output
        pictures.append(read_image(tmp_path / name))
    plain, staged = pictures
    assert staged.shape == (24, 32, 4) and ((staged[..., 3] > 0) & (staged[..., 3] < 1)).mean() > 0.02
    np.testing.assert_allclose(staged[..., 3], plain[..., 3], atol=1.1 / 255)
    some = plain[..., 3] > 0.1
    np.testing.assert_allclose(staged[some], plain[some], atol=2.1 / 255)
    # An environment that is seen covers what is behind.
    write_environment(tmp_path / "sky.hdr", np.ones((2, 4, 3), np.float32))
    with (tmp_path / "stage.toml").open("a") as file:
        file.write("[environment]\nfile = 'sky.hdr'\n")
    done = CliRunner().invoke(cli, [*command, "-o", str(tmp_path / "sky.png")])
    assert done.exit_code == 0 and "no pixel is transparent" in " ".join(done.output.split())
    assert read_image(tmp_path / "sky.png")[..., 3].min() == 1


@pytest.mark.exhaustive
def test_denoiser_keeps_noise_free_pixels() -> None:
    pytest.importorskip("pyoidn")
    floor = StageMesh(shape="plane", scale=2, material=Diffuse())
    stage = Stage(gaussians=(), meshes=(floor, *BALLS), lights=(LAMP,))

    def picture(samples: int, **more: object) -> np.ndarray:
        numbers = Integrator(samples=samples, max_depth=4, **more)  # type: ignore[arg-type]
        return (
            film_of(stage.model_copy(update={"integrator": numbers}), wide, background=0.1).image().rgb_srgb
        )

    wide = camera((0.9, -1.0, -1.2), (0, -0.1, 0), (128, 96), 45)
    truth, noisy, clean = picture(128), picture(2), picture(2, denoise=True)
    assert psnr(clean, truth) > psnr(noisy, truth) + 3, (psnr(clean, truth), psnr(noisy, truth))
    np.testing.assert_array_equal(clean, picture(2, denoise=True))
    nothing = stage.model_copy(update={"meshes": (), "integrator": Integrator(samples=2, denoise=True)})
    assert np.ptp(film_of(nothing, VIEW, background=0.1).image().rgb_linear) == 0
