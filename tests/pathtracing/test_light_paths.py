"""Whole paths against closed forms: furnace, Beer, slabs, mirrors; threads do not change a byte."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.pathtracing.compile_meshes import check_outside_glass, compile_meshes
from octasplat.engine.pathtracing.mesh_files import MeshShape
from octasplat.engine.pathtracing.mesh_shapes import primitive_shape, rotation_matrix, turn_outwards
from octasplat.engine.pathtracing.path_tracer import PathTracer, PathTracerScene
from octasplat.engine.pathtracing.stage.materials import Dielectric, Diffuse, Glass, Metal, Mirror
from octasplat.engine.pathtracing.stage.model import (
    DirectionalLight,
    Environment,
    Integrator,
    PointLight,
    RectangleLight,
    Stage,
    StageMesh,
)
from octasplat.engine.render.image_files import write_exr
from octasplat.engine.render.pinhole_camera import PinholeCamera
from tests.support.light_scenes import camera, film_of, psnr

AHEAD = camera((0, 0, -4), (0, 0, 0), (24, 16), 30)
WHITE = (1.0, 1.0, 1.0)


def white_sky(folder: Path, value: float = 1.0) -> Environment:
    write_exr(folder / "white.exr", {c: np.full((8, 16), value, np.float32) for c in "RGB"})
    return Environment(file="white.exr")


@pytest.mark.parametrize(
    "material",
    [
        Diffuse(color_srgb=WHITE),
        Mirror(),
        Glass(ior=1.5),
        Glass(ior=1.5, roughness=0.5),
        Metal(color_srgb=WHITE, roughness=0.6),
        Metal(color_srgb=WHITE, roughness=0.15),
        Dielectric(color_srgb=WHITE, roughness=0.4),
        Metal(color_srgb=WHITE, roughness=0.6, clear_coat=1.0, clear_coat_roughness=0.2),
    ],
    ids=lambda m: m.kind,
)
def test_white_furnace_has_uniform_radiance(material, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    ball = StageMesh(shape="sphere", smooth_degrees=180, material=material)
    numbers = Integrator(samples=64, max_depth=32, roulette_depth=32)
    stage = Stage(gaussians=(), meshes=(ball,), environment=white_sky(tmp_path), integrator=numbers)
    picture = film_of(stage, AHEAD, tmp_path).image().rgb_linear
    assert abs(picture.mean() - 1.0) < 0.01
    assert np.abs(picture.mean(axis=2) - 1).max() < 0.35


def test_clear_coat_over_black_metal_reflects_four_percent_head_on(tmp_path: Path) -> None:
    for share in (1.0, 0.5):
        black = Metal(color_srgb=(0, 0, 0), clear_coat=share)
        board = StageMesh(shape="plane", rotation_degrees=(90, 0, 0), scale=9, material=black)
        numbers = Integrator(samples=64, max_depth=2, anti_aliasing=False)
        stage = Stage(gaussians=(), meshes=(board,), environment=white_sky(tmp_path), integrator=numbers)
        seen = film_of(stage, camera((0, 0, -4), (0, 0, 0), (4, 4), 0.5), tmp_path).image().rgb_linear
        assert seen.mean() == pytest.approx(0.04 * share, abs=5e-4)


def test_dielectric_slab_follows_beer_and_fresnel(tmp_path: Path) -> None:
    slab = StageMesh(shape="cube", scale=(5, 5, 0.5), material=Glass(ior=1.5, absorption=(0.7, 0.2, 0.0)))
    numbers = Integrator(samples=1024, max_depth=32, roulette_depth=32, anti_aliasing=False)
    black = Stage(gaussians=(), meshes=(slab,), integrator=numbers)
    # Light shines from behind only: a wall there that is its own light.
    wall = RectangleLight(position=(0, 0, 3), direction=(0, 0, -1), width=20, height=20, radiance=1.0)
    stage = black.model_copy(update={"lights": (wall,)})
    straight = camera((0, 0, -4), (0, 0, 0), (8, 8), 0.5)
    seen = film_of(stage, straight, tmp_path).image().rgb_linear.mean(axis=(0, 1))
    inside, fresnel = np.exp(-np.array([0.7, 0.2, 0.0])), 0.04
    through = (1 - fresnel) ** 2 * inside / (1 - (fresnel * inside) ** 2)
    np.testing.assert_allclose(seen, through, atol=0.004)


def test_dielectric_slab_offset_follows_snell(tmp_path: Path) -> None:
    # Under 45 degrees, thickness 1, index 1.5: the ray comes out parallel, displaced sideways.
    slab = StageMesh(shape="cube", scale=(20, 20, 0.5), material=Glass(ior=1.5))
    numbers = Integrator(samples=256, max_depth=3, anti_aliasing=False)
    angle = np.radians(45.0)
    sideways = np.sin(angle) * (1 - np.cos(angle) / np.sqrt(1.5**2 - np.sin(angle) ** 2))
    view = camera((-4, 0, -4), (0, 0, 0), (3, 3), 1e-4)
    across = sideways / np.cos(angle)  # along x, where the ray meets the plane z = 4
    for offset, bright in ((-0.06, True), (0.06, False)):
        # The lamp's right edge lies a little to either side of where the ray arrives.
        lamp = RectangleLight(
            position=(4 - across + offset + 1.0, 0, 4),
            direction=(0, 0, -1),
            width=2.0,
            height=1,
            radiance=1.0,
        )
        lit = Stage(gaussians=(), meshes=(slab,), lights=(lamp,), integrator=numbers)
        seen = film_of(lit, view, tmp_path).image().rgb_linear.mean()
        assert (seen > 0.8) == bright, (offset, seen)


def test_light_inside_glass_is_totally_reflected_beyond_the_critical_angle(tmp_path: Path) -> None:
    # A prism of two right angles' halves: what enters its short face head-on turns by 90 degrees at the long
    # one, where it arrives under 45 degrees; asin(1 / 1.5) is 41.8.
    obj = "v -1 -9 -1\nv 1 -9 -1\nv -1 -9 1\nv -1 9 -1\nv 1 9 -1\nv -1 9 1\n"
    obj += "f 1 2 3\nf 4 6 5\nf 1 4 5 2\nf 1 3 6 4\nf 2 5 6 3\n"
    (tmp_path / "prism.obj").write_text(obj)
    prism = StageMesh(file="prism.obj", smooth_degrees=0, material=Glass(ior=1.5))
    lamp = RectangleLight(position=(-4, 0, 0), direction=(1, 0, 0), width=9, height=9, radiance=1.0)
    numbers = Integrator(samples=512, max_depth=16, roulette_depth=16, anti_aliasing=False)
    stage = Stage(gaussians=(), meshes=(prism,), lights=(lamp,), integrator=numbers)
    seen = film_of(stage, camera((-0.3, 0, -6), (-0.3, 0, 0), (4, 4), 0.5), tmp_path).image().rgb_linear
    # In by one face and out by the other with 4 % lost at each; what is reflected at the exit comes back and
    # leaves towards the camera, where nothing shines.
    assert abs(seen.mean() - 0.96**2) < 0.01


def test_rectangle_light_floor_form_factor(tmp_path: Path) -> None:
    floor = StageMesh(shape="plane", scale=50, material=Diffuse(color_srgb=WHITE))
    lamp = RectangleLight(position=(0, -1, 0), direction=(0, 1, 0), width=1.4, height=2.0, radiance=2.0)
    numbers = Integrator(samples=4096, max_depth=1, anti_aliasing=False)
    stage = Stage(gaussians=(), meshes=(floor,), lights=(lamp,), integrator=numbers)
    under = camera((-3, -1.5, 0), (0, 0, 0), (3, 3), 1e-3)
    a, b = 0.7, 1.0
    corner = (
        a / np.hypot(1, a) * np.arctan(b / np.hypot(1, a))
        + b / np.hypot(1, b) * np.arctan(a / np.hypot(1, b))
    ) / (2 * np.pi)
    seen = film_of(stage, under, tmp_path).image().rgb_linear
    np.testing.assert_allclose(seen.mean(), 2.0 * 4 * corner, rtol=5e-3)


def test_mirror_shows_mesh_of_virtual_camera(tmp_path: Path) -> None:
    things = (
        StageMesh(
            shape="cube", scale=0.4, position=(0.3, 0.1, -1), material=Diffuse(color_srgb=(0.9, 0.3, 0.1))
        ),
        StageMesh(shape="sphere", scale=0.4, position=(-0.5, -0.2, -1.5), material=Diffuse()),
    )
    mirror = StageMesh(
        shape="plane", rotation_degrees=(90, 0, 0), position=(0, 0, 1), scale=9, material=Mirror()
    )
    light = (PointLight(position=(1, -2, -4), intensity=12),)
    direct_light = Integrator(samples=1, max_depth=1, anti_aliasing=False)
    one_more = Integrator(samples=1, max_depth=2, anti_aliasing=False)
    seen_in_mirror = Stage(gaussians=(), meshes=(*things, mirror), lights=light, integrator=one_more)
    # One stands before the mirror and looks into it, the other as far behind, left for right.
    through = film_of(seen_in_mirror, camera((0, 0, 0.5), (0, 0, 1), (40, 30), 60), tmp_path)
    direct = film_of(
        Stage(gaussians=(), meshes=things, lights=light, integrator=direct_light),
        camera((0, 0, 1.5), (0, 0, 1), (40, 30), 60),
        tmp_path,
    )
    a, b = through.image().rgb_srgb, direct.image().rgb_srgb[:, ::-1]
    assert a.max() > 0.2
    assert psnr(a, b) > 50


def test_render_depends_on_seed_not_on_threads(tmp_path: Path) -> None:
    meshes = (
        StageMesh(shape="plane", scale=3, position=(0, 1, 0)),
        StageMesh(shape="sphere", smooth_degrees=180, material=Glass()),
        StageMesh(shape="cube", scale=0.4, position=(1, 0.6, -1), material=Metal(roughness=0.4)),
    )
    lamp = RectangleLight(position=(0, -3, -1), direction=(0, 1, 0), width=1, height=1, radiance=9.0)
    sun = DirectionalLight(direction=(1, 2, 1), irradiance=1.0)
    stage = Stage(
        gaussians=(), meshes=meshes, lights=(lamp, sun), environment=white_sky(tmp_path, 0.3),
        integrator=Integrator(samples=100, max_depth=5, aperture=0.1, focus_distance=3.5),
    )  # fmt: skip
    view = camera((0, -0.5, -4), (0, 0, 0), (60, 40), 40)
    one = film_of(stage, view, tmp_path, threads=1).image(tone="filmic")
    two = film_of(stage, view, tmp_path, threads=2).image(tone="filmic")
    assert one.rgb_linear.tobytes() == two.rgb_linear.tobytes()
    assert one.rgb_srgb.tobytes() == two.rgb_srgb.tobytes()
    other = stage.model_copy(update={"integrator": stage.integrator.model_copy(update={"seed": 1})})
    assert film_of(other, view, tmp_path).image().rgb_linear.tobytes() != one.rgb_linear.tobytes()


def test_depth_of_field_blurs_out_of_focus_objects(tmp_path: Path) -> None:
    edge = StageMesh(
        shape="cube", position=(-1, 0, 0), scale=(1, 9, 0.001), material=Diffuse(color_srgb=WHITE)
    )
    light = (DirectionalLight(direction=(0, 0, 1), irradiance=3.0),)
    view = camera((0, 0, -4), (0, 0, 0), (64, 8), 1)

    def edge_width(focus: float) -> float:
        numbers = Integrator(samples=64, max_depth=1, aperture=0.2, focus_distance=focus)
        stage = Stage(gaussians=(), meshes=(edge,), lights=light, integrator=numbers)
        row = film_of(stage, view, tmp_path).image().rgb_linear[4, :, 0]
        return float(((row > 0.05 * row.max()) & (row < 0.95 * row.max())).sum())

    # Out of focus by half, a point at 4 is as wide as half the lens: 0.1 at 4, which are 11 pixels.
    assert edge_width(4.0) <= 1
    assert 6 <= edge_width(8.0 / 3.0) <= 14


def test_plane_across_the_axis_is_in_focus_wherever_the_axis_meets_the_picture(tmp_path: Path) -> None:
    slats = tuple(
        StageMesh(
            shape="cube", position=(x, 0, 4), scale=(0.05, 9, 0.001), material=Diffuse(color_srgb=WHITE)
        )
        for x in np.arange(0, 4, 0.2)
    )
    sun = DirectionalLight(direction=(0, 0, 1), irradiance=3.0)
    view = PinholeCamera.from_pose(np.eye(4), 96, 8, fy_px=96, cx_px=0)

    def row(**lens: float) -> np.ndarray:
        numbers = Integrator(samples=64, max_depth=1, **lens)
        stage = Stage(gaussians=(), meshes=slats, lights=(sun,), integrator=numbers)
        return film_of(stage, view, tmp_path).image().rgb_linear[4, :, 0]

    assert np.abs(row(aperture=0.5, focus_distance=4.0) - row()).mean() < 2e-3


@pytest.mark.parametrize("half_side", [10.0, 1e3, 1e5])
def test_large_sloping_ground_neither_shadows_nor_mirrors_itself(half_side: float, tmp_path: Path) -> None:
    slope = (17.0, 0.0, 31.0)
    up = rotation_matrix(slope) @ np.array([0.0, -1.0, 0.0])
    x, y, z = up.tolist()
    sun = DirectionalLight(direction=(-x, -y, -z), irradiance=np.pi)
    sky = RectangleLight(
        position=(3 * x, 3 * y, 3 * z), direction=(-x, -y, -z), width=99, height=99, radiance=1
    )
    eye = tuple((2 * up + (0.01, 0.02, -0.3)).tolist())
    view = camera(eye, (0.3, 0, 0.2), (32, 24), 40)
    for material, light in ((Diffuse(color_srgb=WHITE), sun), (Mirror(), sky)):
        ground = StageMesh(shape="plane", scale=half_side, rotation_degrees=slope, material=material)
        numbers = Integrator(samples=16, max_depth=2)
        stage = Stage(gaussians=(), meshes=(ground,), lights=(light,), integrator=numbers)
        seen = film_of(stage, view, tmp_path).image().rgb_linear
        np.testing.assert_allclose(seen, 1.0, atol=1e-5)


def test_light_of_a_point_goes_straight_through_a_pane(tmp_path: Path) -> None:
    floor = StageMesh(shape="plane", position=(0, 1, 0), scale=9, material=Diffuse(color_srgb=WHITE))
    pane = StageMesh(
        shape="cube", scale=(3, 0.5, 3), position=(0, -2, 0), material=Glass(ior=1.5, absorption=(0.5, 0, 0))
    )
    sun = DirectionalLight(direction=(0, 1, 0), irradiance=np.pi / 2)
    numbers = Integrator(samples=1, max_depth=1, anti_aliasing=False)
    stage = Stage(gaussians=(), meshes=(floor, pane), lights=(sun,), integrator=numbers)
    seen = film_of(stage, camera((-3, 0.5, 0), (0, 1, 0), (3, 3), 1e-3), tmp_path).image().rgb_linear
    np.testing.assert_allclose(seen.mean(axis=(0, 1)), 0.5 * 0.96**2 * np.exp([-0.5, 0, 0]), rtol=1e-4)


def absorbing(height: float, half: float) -> StageMesh:
    """A slab of index 1 that absorbs, its middle at a height over the floor."""
    material = Glass(ior=1.0, absorption=(0.1, 0.1, 0.1))
    return StageMesh(shape="cube", position=(0, -height, 0), scale=(8, half, 8), material=material)


GAUZE = StageMesh(shape="plane", position=(0, -5, 0), scale=3, material=Diffuse(opacity=0.5))


@pytest.mark.parametrize(
    ("meshes", "height", "side", "left"),
    [
        ((absorbing(5, 4),), 5, 0, np.exp(-0.4)),
        ((absorbing(5, 4), GAUZE), 20, 0, 0.5 * np.exp(-0.8)),
        ((absorbing(0, 8),), 5, 0, np.exp(-0.5 - 0.8)),
        ((absorbing(0, 8),), 5, 2, np.exp(-0.5 - 0.8)),
        (tuple(absorbing(2 + k, 0.25) for k in range(12)), 20, 0, np.exp(-0.6)),
    ],
    ids=["lamp-inside", "gauze-inside", "both-inside", "area-and-floor-inside", "many-slabs"],
)
def test_light_of_lamps_is_absorbed_on_all_of_its_way_through_glass(
    meshes: tuple[StageMesh, ...], height: float, side: float, left: float
) -> None:
    light: PointLight | RectangleLight = PointLight(position=(0, -height, 0), intensity=np.pi * height**2)
    if side:
        light = RectangleLight(
            position=(0, -height, 0), direction=(0, 1, 0), width=side, height=side, radiance=1, visible=False
        )
    floor = StageMesh(shape="plane", scale=3, material=Diffuse(color_srgb=WHITE))
    numbers = Integrator(samples=4, max_depth=2, anti_aliasing=False)
    # below what hangs in the air, or above what the floor lies in
    eye = -0.9 if meshes[0].position[1] else -9.0
    view = camera((0.01, eye, 0), (0, 0, 0), (2, 2), 0.1)
    seen = [
        film_of(Stage(gaussians=(), meshes=things, lights=(light,), integrator=numbers), view)
        .image()
        .rgb_linear.mean()
        for things in ((floor, *meshes), (floor,))
    ]
    assert seen[0] / seen[1] == pytest.approx(left, rel=0.01)


def test_open_glass_and_camera_inside_glass_are_refused(tmp_path: Path) -> None:
    ball = StageMesh(shape="sphere", material=Glass())
    meshes = compile_meshes(Stage(gaussians=(), meshes=(ball,)), tmp_path)
    with pytest.raises(ConfigError, match=r"a\.png: the camera stands inside"):
        check_outside_glass(meshes, np.array([0.1, 0.2, 0.3], np.float32), "a.png")
    check_outside_glass(meshes, np.array([0.1, 0.2, 1.3], np.float32), "a.png")
    check_outside_glass(meshes, np.array([-3, -3, -3], np.float32), "a.png")
    (tmp_path / "leaf.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(ConfigError, match=r"leaf\.obj is not closed"):
        compile_meshes(Stage(meshes=(StageMesh(file="leaf.obj", material=Glass()),)), tmp_path)


def test_glass_that_faces_inwards_is_turned_and_told(tmp_path: Path) -> None:
    ball = primitive_shape("sphere")
    for name, faces in (("right.obj", ball.faces), ("inside_out.obj", ball.faces[:, ::-1])):
        lines = [f"v {x} {y} {z}" for x, y, z in ball.vertices]
        lines += [f"f {a} {b} {c}" for a, b, c in faces + 1]
        (tmp_path / name).write_text("\n".join(lines))
    seen, told = [], []
    for name in ("right.obj", "inside_out.obj"):
        stage = Stage(
            gaussians=(), meshes=(StageMesh(file=name, material=Glass(absorption=(0.5, 0.1, 0.0))),)
        )
        compiled = compile_meshes(stage, tmp_path, warn=told.append)
        seen.append(np.sort(compiled.surfaces.corner_normals.reshape(-1, 3), axis=0))
    np.testing.assert_allclose(seen[1], seen[0], atol=1e-5)
    assert len(told) == 1 and "inside_out.obj faces inwards" in told[0]


@pytest.mark.parametrize(
    ("balls", "turned"),
    [
        ([(0, 1.0, 1), (5, 0.5, -1)], [False, True]),  # beside each other
        ([(0, 1.0, 1), (0, 0.5, -1)], [False, False]),  # a bubble
        ([(0, 1.0, -1), (0, 0.5, 1), (5, 2.0, 1)], [True, True, False]),  # another one, inside out
        ([(0, 1.0, 1), (0, 0.5, 1)], [False, False]),
    ],
)
def test_each_solid_of_glass_is_turned_by_itself(
    balls: list[tuple[float, float, int]], turned: list[bool]
) -> None:
    ball = primitive_shape("sphere")
    count = len(ball.vertices)
    faces = [ball.faces[:, ::side] + count * k for k, (_, _, side) in enumerate(balls)]
    shape = MeshShape(
        np.concatenate([radius * ball.vertices + [x, 0, 0] for x, radius, _ in balls]), np.concatenate(faces)
    )
    found = turn_outwards(shape, np.ones(len(shape.faces), bool))
    changed = shape.faces[:, 0:0].any(axis=1) if found is None else (found.faces != shape.faces).any(axis=1)
    assert [part.all() for part in np.split(changed, len(balls))] == turned
    assert [part.any() for part in np.split(changed, len(balls))] == turned


def test_neither_threads_nor_samples_added_later_change_a_picture_of_meshes() -> None:
    balls = [
        StageMesh(shape="sphere", scale=0.6, position=(1.4 * k - 1.4, 0, 0), smooth_degrees=180, material=m)
        for k, m in enumerate((Glass(), Metal(roughness=0.4), Mirror()))
    ]
    floor = StageMesh(shape="plane", position=(0, 0.6, 0), scale=4)
    lamp = RectangleLight(position=(1, -3, 0), direction=(0, 1, 0), width=1, height=1, radiance=5)
    lights = (PointLight(position=(0, -3, -2), intensity=9), lamp)
    numbers = Integrator(samples=12, max_depth=4)
    stage = Stage(gaussians=(), meshes=(floor, *balls), lights=lights, integrator=numbers)
    view = camera((0, -1, -4), (0, 0, 0), (64, 48), 50)  # more paths than one thread follows at a time
    one, two = (film_of(stage, view, threads=threads).image().rgb_linear for threads in (1, 2))
    np.testing.assert_array_equal(one, two)
    scene = PathTracerScene(compile_meshes(stage, Path(), threads=2))
    *_, last = PathTracer(scene, numbers, threads=2).refine(view.rays())
    np.testing.assert_allclose(last.image().rgb_linear, one, atol=1e-6)
