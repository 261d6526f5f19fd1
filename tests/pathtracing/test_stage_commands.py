"""``octasplat stage`` and ``octasplat render --stage`` on a file of Gaussians."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

import octasplat as osp
from octasplat.engine.core.events import Warned
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.pathtracing.stage.stage_file import read_stage
from octasplat.engine.pathtracing.stage_layout import estimate_stage_layout
from octasplat.engine.render.image_files import read_image
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import TraceSettings
from octasplat.workers.cli.main import cli
from tests.support.image_channels import read_channels
from tests.support.light_scenes import shiny_ball, table_with_a_box


def octasplat(*arguments: object) -> Result:
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A table (y = 0, up is -y) with a box on it, as Gaussians."""
    path = tmp_path_factory.mktemp("scene") / "scene.ply"
    write_gaussian_ply(table_with_a_box(), path)
    return path


SMALL = ("--turntable", "--frames", 2, "--width", 48, "--height", 36, "--threads", 2)


def test_stage_init_without_floor_places_object_in_air(tmp_path: Path) -> None:
    x, y = np.meshgrid(*[np.linspace(-1, 1, 40, dtype=np.float32)] * 2)
    count = x.size  # a wall: the normals look along z, up is -y
    some = FlatGaussians(
        np.stack([x.ravel(), y.ravel(), np.zeros(count, np.float32)], axis=1),
        np.tile(np.float32([np.sqrt(0.5), 0, -np.sqrt(0.5), 0]), (count, 1)),
        np.full((count, 2), -3.5, np.float32), np.full(count, 4.0, np.float32),
        np.zeros((count, 1, 3), np.float32),
    )  # fmt: skip
    write_gaussian_ply(some, tmp_path / "wall.ply")
    stage = tmp_path / "stage.toml"
    done = octasplat("stage", "init", tmp_path / "wall.ply", "-o", stage)
    assert done.exit_code == 0, done.output
    assert "No floor is to be seen" in stage.read_text()
    assert read_stage(stage).meshes[0].shape == "sphere"


def test_stage_init_object_stands_on_surface_and_renders(scene: Path, tmp_path: Path) -> None:
    stage = tmp_path / "stage.toml"
    done = octasplat("stage", "init", scene, "-o", stage)
    assert done.exit_code == 0 and "up is" in done.output, done.output
    read = read_stage(stage)
    ball = read.meshes[0]
    assert isinstance(ball.scale, float)
    # It touches the table, and does not stand in the box.
    assert abs(ball.position[1] + ball.scale) < 0.1 * ball.scale
    assert max(abs(ball.position[0]), abs(ball.position[2])) > 0.2
    again = octasplat("stage", "init", scene, "-o", stage)
    assert again.exit_code == 1 and "is there already" in again.output
    text = stage.read_text().replace("samples = 16", "samples = 2")
    stage.write_text(text)
    plain, staged = tmp_path / "plain", tmp_path / "staged"
    for more, folder in (((), plain), (("--stage", stage), staged)):
        done = octasplat("render", scene, "-o", folder, *SMALL, *more)
        assert done.exit_code == 0, done.output
    pictures = [read_image(folder / "frame_0000.png") for folder in (plain, staged)]
    assert 0.01 < (np.abs(pictures[0] - pictures[1]).max(axis=2) > 0.05).mean() < 0.6


def test_stage_object_rests_on_surface(scene: Path, tmp_path: Path) -> None:
    stage = tmp_path / "stage.toml"
    stage.write_text(
        "[[gaussians]]\nlight = 'emissive'\n[[meshes]]\nshape = 'cube'\nscale = 0.1\n"
        "on = { origin = [0.6, -2, 0.5], direction = [0, 1, 0] }\n"
        "material = { kind = 'diffuse', color_srgb = [0, 0, 0] }\n[integrator]\nsamples = 1\n"
    )
    done = octasplat("render", scene, "-o", tmp_path / "one.exr", "--preview", "--stage", stage, *SMALL)
    assert done.exit_code == 0, done.output
    channels = read_channels(tmp_path / "one.exr")
    assert set(channels) == {"R", "G", "B", "A"} and channels["A"].max() > 0.99


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("color = 1", "there is no key color"),
        ("[environment]\nfile = 'sky.hdr'", "there is no file"),
        ("[environment]\nfile = 'no_picture.hdr'", "no_picture.hdr"),
        ("[[meshes]]\nfile = 'leaf.obj'\nmaterial = { kind = 'glass' }", "is not closed"),
        (
            "[[meshes]]\nshape = 'sphere'\nscale = 50\nmaterial = { kind = 'glass' }",
            "the camera stands inside",
        ),
        (
            "[[meshes]]\nshape = 'cube'\non = { origin = [0, -2, 0], direction = [0, -1, 0] }",
            "the ray meets nothing solid",
        ),
        (
            "[[meshes]]\nshape = 'cube'\non = { view = 'a.jpg', pixel = [1, 1] }",
            "meshes[0].on: a.jpg: a file of",
        ),
    ],
)
def test_invalid_stage_is_refused_before_rendering(
    scene: Path, tmp_path: Path, text: str, words: str
) -> None:
    (tmp_path / "leaf.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (tmp_path / "no_picture.hdr").write_bytes(b"no picture")
    stage = tmp_path / "stage.toml"
    stage.write_text(text + "\n")
    done = octasplat("render", scene, "-o", tmp_path / "out", "--stage", stage, *SMALL)
    assert done.exit_code == 1 and words in done.output, done.output
    assert done.output.count("Error:") == 1 and "Traceback" not in done.output
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("light", "told"), [("shadowed", True), ("relit", False)])
def test_stage_without_the_materials_of_its_scene_says_so(tmp_path: Path, light: str, told: bool) -> None:
    ball = shiny_ball(100, 1.0, albedo=(1, 1, 1), metallic=1.0, roughness=0.2)
    write_gaussian_ply(ball, tmp_path / "ball.ply")
    (tmp_path / "stage.toml").write_text(f"[[gaussians]]\nlight = '{light}'\n[integrator]\nsamples = 1\n")
    one = ("-o", tmp_path, "--turntable", "--frames", 1, "--width", 16, "--height", 16, "--threads", 1)
    done = octasplat("render", tmp_path / "ball.ply", "--stage", tmp_path / "stage.toml", *one)
    assert done.exit_code == 0, done.output
    assert ("materials are left out on this stage" in " ".join(done.output.split())) == told


@pytest.mark.parametrize(("light", "told"), [("emissive", True), ("shadowed", False)])
def test_lamp_that_adds_nothing_to_emissive_gaussians_says_so(
    scene: Path, tmp_path: Path, light: str, told: bool
) -> None:
    (tmp_path / "stage.toml").write_text(
        f"[[gaussians]]\nlight = '{light}'\n[integrator]\nsamples = 1\n"
        "[[lights]]\nkind = 'directional'\ndirection = [0, 1, 0]\nirradiance = 1\n"
        "[[lights]]\nkind = 'directional'\ndirection = [0, 1, 0]\nirradiance = 1\nadds_light = true\n"
    )
    done = octasplat("render", scene, "-o", tmp_path / "a", "--stage", tmp_path / "stage.toml", *SMALL)
    assert done.exit_code == 0, done.output
    words = "lights[1].adds_light: the scene takes no light of it"
    assert (words in " ".join(done.output.split())) == told and "lights[0]" not in done.output
    heard: list[object] = []
    osp.render(
        scene, tmp_path / "b", stage_file=tmp_path / "stage.toml", progress=heard.append,
        mode="turntable", frames=2, width_px=48, height_px=36, threads=2,
    )  # fmt: skip
    assert any(isinstance(event, Warned) and words in event.message for event in heard) == told


def test_preview_wants_a_stage_and_one_file(scene: Path, tmp_path: Path) -> None:
    assert octasplat("render", scene, "-o", tmp_path / "a.png", "--preview").exit_code == 2


def pillar() -> FlatGaussians:
    """A pillar of radius 0.2 from y = 0 up to y = -2 with a shelf at half height: up is -y."""
    angle, height = (part.ravel() for part in np.meshgrid(np.linspace(0, 6.2, 40), np.linspace(0, -2, 40)))
    shelf_x, shelf_z = (part.ravel() for part in np.meshgrid(*[np.linspace(-0.35, 0.35, 20)] * 2))
    means = np.concatenate(
        [
            np.stack([0.2 * np.cos(angle), height, 0.2 * np.sin(angle)], axis=1),
            np.stack([shelf_x, np.full(shelf_x.size, -1.0), shelf_z], axis=1),
        ]
    ).astype(np.float32)
    half = np.sqrt(0.5)
    around = np.stack(
        [np.cos(angle / 2), 0 * angle, -np.sin(angle / 2), 0 * angle], axis=1
    )  # x to the normal
    flat = np.tile([half, 0, 0, -half], (shelf_x.size, 1))  # the normal along -y
    count = len(means)
    return FlatGaussians(
        means,
        np.concatenate([around, flat]).astype(np.float32),
        np.full((count, 2), -3.5, np.float32),
        np.full(count, 4.0, np.float32),
        np.zeros((count, 1, 3), np.float32),
    )


def test_stage_init_thing_that_stands_alone_has_its_floor_at_its_foot(tmp_path: Path) -> None:
    write_gaussian_ply(pillar(), tmp_path / "pillar.ply")
    done = octasplat("stage", "init", tmp_path / "pillar.ply", "-o", tmp_path / "stage.toml")
    assert done.exit_code == 0, done.output
    assert "a thing that stands alone" in (tmp_path / "stage.toml").read_text()
    ball = read_stage(tmp_path / "stage.toml").meshes[0]
    assert isinstance(ball.scale, float)
    assert ball.position[1] + ball.scale == pytest.approx(0.0, abs=0.05)
    assert np.hypot(ball.position[0], ball.position[2]) > 0.2 + ball.scale


def test_stage_init_thing_on_thin_legs_has_its_floor_below_them(tmp_path: Path) -> None:
    grid = np.linspace(-1, 1, 40)
    seat_x, seat_z = (part.ravel() for part in np.meshgrid(grid, grid))
    legs = np.linspace(0.0, -1.0, 60)  # from the floor up to the seat: up is -y
    places = [np.stack([seat_x, np.full(seat_x.size, -1.0), seat_z], axis=1)]
    places += [
        np.stack([np.full(legs.size, x), legs, np.full(legs.size, z)], axis=1)
        for x in (-0.9, 0.9) for z in (-0.9, 0.9)
    ]  # fmt: skip
    means, half = np.concatenate(places).astype(np.float32), np.sqrt(0.5)
    quats = np.tile(np.float32([1, 0, 0, 0]), (len(means), 1))
    quats[: seat_x.size] = [half, 0, 0, -half]  # the normal along -y
    scales = np.full((len(means), 2), -3.5, np.float32)
    scales[seat_x.size :] = -4.5
    chair = FlatGaussians(
        means, quats, scales, np.full(len(means), 4.0, np.float32), np.zeros((len(means), 1, 3), np.float32)
    )
    write_gaussian_ply(chair, tmp_path / "chair.ply")
    done = octasplat("stage", "init", tmp_path / "chair.ply", "-o", tmp_path / "stage.toml")
    assert done.exit_code == 0, done.output
    assert "A file does not say what is up" in done.stderr and "--up" in done.stderr
    assert "A file does not say what is up" in (tmp_path / "stage.toml").read_text()
    ball = read_stage(tmp_path / "stage.toml").meshes[0]
    assert isinstance(ball.scale, float)
    assert ball.position[1] + ball.scale == pytest.approx(0.0, abs=0.15)


def test_cameras_around_a_file_hold_the_stages_up_upright(scene: Path, tmp_path: Path) -> None:
    stage = tmp_path / "stage.toml"
    stage.write_text("up = [0, 0, 1]\n[[gaussians]]\nlight = 'emissive'\n[integrator]\nsamples = 1\n")
    for name, more in (("staged", ("--stage", stage)), ("told", ("--up", "z")), ("plain", ())):
        done = octasplat("render", scene, "-o", tmp_path / name, *SMALL, *more)
        assert done.exit_code == 0, done.output
    staged, told, plain = (
        read_image(tmp_path / name / "frame_0000.png") for name in ("staged", "told", "plain")
    )
    assert np.abs(staged - told).mean() < 0.02 < np.abs(plain - told).mean()
    done = octasplat("render", scene, "-o", tmp_path / "asked", *SMALL, "--up", "-y", "--stage", stage)
    asked = read_image(tmp_path / "asked" / "frame_0000.png")
    assert done.exit_code == 0 and np.abs(asked - plain).mean() < 0.02


def test_stage_init_ball_beside_a_thing_is_towards_the_first_camera() -> None:
    tracer = make_tracer(TraceSettings(), threads=1)
    tracer.build(pillar())
    cameras = np.array([[4.0, -2, 0], [-4, -2, 1], [-4, -2, -1]])
    up, centre = np.array([0.0, -1, 0]), np.array([0.0, -1, 0])
    found = estimate_stage_layout(pillar(), tracer, up, centre, 1.5, cameras)
    assert found.is_beside and found.floor[0] > 0.3
