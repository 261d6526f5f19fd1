"""Gaussians among meshes: seen in mirrors and through glass, casting and taking shadows, lit anew."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.color import linear_to_srgb, srgb_to_linear
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians
from octasplat.engine.pathtracing.compile_meshes import compile_meshes
from octasplat.engine.pathtracing.gaussian_layers import build_gaussian_layers
from octasplat.engine.pathtracing.path_tracer import PathTracer, PathTracerScene
from octasplat.engine.pathtracing.stage.materials import Diffuse, Glass, Mirror
from octasplat.engine.pathtracing.stage.model import (
    DirectionalLight,
    Environment,
    Integrator,
    PointLight,
    RectangleLight,
    Stage,
    StageGaussians,
    StageMesh,
)
from octasplat.engine.render.image_files import write_exr
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.engine.render.renderer import render_rays
from octasplat.engine.trace.cpu.tracer import CpuTracer
from octasplat.engine.trace.protocol import TraceSettings
from tests.support.light_scenes import camera, film_of, psnr, table_with_a_box

PLAIN = Integrator(samples=1, max_depth=6, roulette_depth=64, anti_aliasing=False)


def cloud(
    count: int, seed: int = 0, spread: float = 0.6, centre: tuple[float, ...] = (0, 0, 0)
) -> FlatGaussians:
    """Colored Gaussians of all opacities, their colors dependent on the direction."""
    rng = np.random.default_rng(seed)
    sh = rng.normal(0, 0.08, (count, 4, 3))
    sh[:, 0] = (rng.random((count, 3)) - 0.5) / SH_C0
    return FlatGaussians(
        (rng.normal(0, spread / 2, (count, 3)) + centre).astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        rng.uniform(-3, -1.5, (count, 2)).astype(np.float32),
        rng.uniform(-2, 4, count).astype(np.float32),
        sh.astype(np.float32),
    )


def wall(
    z: float, half: float, per_side: int = 40, color: float = 0.5, overlap: float = 1.0
) -> FlatGaussians:
    """Gaussians side by side in the plane z: opaque where they overlap well."""
    x, y = np.meshgrid(*[(np.arange(per_side) + 0.5) / per_side * 2 * half - half] * 2)
    count = per_side**2
    sh = np.full((count, 1, 3), (color - 0.5) / SH_C0, np.float32)
    quats = np.tile(np.float32([np.sqrt(0.5), 0, -np.sqrt(0.5), 0]), (count, 1))  # the normal along z
    return FlatGaussians(
        np.stack([x.ravel(), y.ravel(), np.full(count, z)], axis=1).astype(np.float32),
        quats,
        np.full((count, 2), np.log(overlap * 2 * half / per_side), np.float32),
        np.full(count, 12.0, np.float32),
        sh,
    )


def picture(
    stage: Stage,
    view: PinholeCamera,
    gaussians: FlatGaussians,
    folder: Path = Path(),
    background: float = 0.0,
    threads: int = 2,
) -> np.ndarray:
    """Display values of a stage."""
    layers = build_gaussian_layers(
        stage,
        gaussians,
        lambda path: pytest.fail(str(path)),
        folder,
        TraceSettings(),
        size=1.0,
        threads=threads,
    )
    scene = PathTracerScene(compile_meshes(stage, folder, threads=threads), layers, np.full(3, background))
    return PathTracer(scene, stage.integrator, threads=threads).render(view.rays()).image().rgb_srgb


def plainly(gaussians: FlatGaussians, view: PinholeCamera, background: float = 0.0) -> np.ndarray:
    """The picture that the renderer of scenes makes; the background is a display value."""
    tracer = CpuTracer(TraceSettings())
    tracer.build(gaussians)
    return render_rays(tracer, view.rays(), np.full(3, background, np.float32)).rgb_srgb


def emissive(*meshes: StageMesh, numbers: Integrator = PLAIN, **more: object) -> Stage:
    return Stage(gaussians=(StageGaussians(light="emissive"),), meshes=meshes, integrator=numbers, **more)  # type: ignore[arg-type]


VIEW = camera((0, 0, -2.5), (0, 0, 0), (48, 36), 45)


def test_empty_stage_equals_plain_render() -> None:
    some = cloud(300)
    grey = 0.5
    shown = picture(emissive(), VIEW, some, background=((grey + 0.055) / 1.055) ** 2.4)
    assert psnr(shown, plainly(some, VIEW, grey)) > 80


def test_scenes_with_channels_of_their_own_stand_in_one_stage() -> None:
    plain, labelled = cloud(100), cloud(100, seed=1, centre=(0.5, 0, 0))
    channels = {"label": np.ones((100, 1), np.float32), "albedo": np.ones((100, 3), np.float32)}
    other = plain.with_channels({"label": np.ones((100, 2), np.float32)})
    entries = (StageGaussians(light="emissive"), StageGaussians(file="b.ply", light="emissive"))
    stage = Stage(gaussians=entries, integrator=PLAIN)

    def shown(first: FlatGaussians, second: FlatGaussians) -> np.ndarray:
        layers = build_gaussian_layers(stage, first, lambda path: second, Path(), TraceSettings(), size=1.0)
        scene = PathTracerScene(compile_meshes(stage, Path()), layers)
        return PathTracer(scene, PLAIN).render(VIEW.rays()).image().rgb_srgb

    expected = shown(plain, labelled)
    for first in (plain, other):
        np.testing.assert_array_equal(shown(first, labelled.with_channels(channels)), expected)


def test_dielectric_slab_index_one_is_invisible() -> None:
    some = cloud(300)
    # It cuts through the Gaussians, so that each ray has three layers of them.
    slab = StageMesh(shape="cube", scale=(5, 5, 0.15), rotation_degrees=(0, 20, 0), material=Glass(ior=1.0))
    shown = picture(emissive(slab), VIEW, some, background=0.2)
    assert psnr(shown, picture(emissive(), VIEW, some, background=0.2)) > 60


def test_mirror_shows_gaussians_of_virtual_camera() -> None:
    some = cloud(300, centre=(0, 0, -1.5))
    mirror = StageMesh(
        shape="plane", rotation_degrees=(90, 0, 0), position=(0, 0, 1), scale=9, material=Mirror()
    )
    into = camera((0.1, 0.05, 0.2), (0, 0, 1), (48, 36), 60)
    behind = camera((0.1, 0.05, 1.8), (0, 0, 1), (48, 36), 60)
    direct = plainly(some, behind, 0.3)[:, ::-1]
    assert direct.std() > 0.05
    shown = picture(emissive(mirror), into, some, background=((0.3 + 0.055) / 1.055) ** 2.4)
    assert psnr(shown, direct) > 50


@pytest.mark.parametrize("light", ["emissive", "shadowed"])
def test_mirror_that_absorbs_dims_what_perfect_mirror_shows(light: str) -> None:
    some = cloud(300, centre=(0, 0, -1.5))
    into = camera((0.1, 0.05, 0.2), (0, 0, 1), (48, 36), 60)
    numbers = Integrator(samples=64, anti_aliasing=True)  # outlines are where the rules of compositing differ

    def mirrored(reflectance: float) -> np.ndarray:
        color = ((1.055 * reflectance ** (1 / 2.4) - 0.055),) * 3
        mirror = StageMesh(
            shape="plane", rotation_degrees=(90, 0, 0), position=(0, 0, 1), scale=9,
            material=Mirror(color_srgb=color),
        )  # fmt: skip
        stage = Stage(gaussians=(StageGaussians(light=light),), meshes=(mirror,), integrator=numbers)
        return picture(stage, into, some, background=((0.3 + 0.055) / 1.055) ** 2.4)

    perfect = mirrored(1.0)
    assert psnr(mirrored(0.999), perfect) > 60
    half = linear_to_srgb(0.5 * srgb_to_linear(perfect))
    assert psnr(mirrored(0.5), half) > 45


@pytest.mark.parametrize("light", ["directional", "point", "rectangle"])
def test_gaussian_wall_shadow_equals_mesh_shadow(light: str) -> None:
    floor = StageMesh(
        shape="plane", position=(0, 1, 0), scale=4, material=Diffuse(color_srgb=(0.8, 0.8, 0.8))
    )
    lamps = {
        "directional": DirectionalLight(direction=(0.2, 0.7, 1), irradiance=3),
        "point": PointLight(position=(0.3, -1, -2.5), intensity=20),
        "rectangle": RectangleLight(
            position=(0.3, -1.5, -2.5), direction=(0, 0.7, 1), width=0.4, height=0.4, radiance=60
        ),
    }
    numbers = Integrator(samples=16, max_depth=1, anti_aliasing=False)
    view = camera((0, -2, 4), (0, 0.8, 1), (48, 36), 45)
    plate = StageMesh(shape="cube", scale=(0.5, 0.5, 1e-4), material=Diffuse(color_srgb=(0, 0, 0)))
    lights = {"lights": (lamps[light],)}
    with_mesh = Stage(gaussians=(), meshes=(floor, plate), integrator=numbers, **lights)
    black = wall(0.0, 0.5, color=0.0)
    by_mesh = picture_without(with_mesh, view)
    by_gaussians = picture(emissive(floor, numbers=numbers, **lights), view, black)
    empty = picture_without(Stage(gaussians=(), meshes=(floor,), integrator=numbers, **lights), view)
    assert (np.abs(empty - by_mesh).max(axis=2) > 0.2).mean() > 0.05
    # The Gaussians end softly; only where the mesh's edge falls the two may differ.
    assert (np.abs(by_mesh - by_gaussians).max(axis=2) > 0.1).mean() < 0.03


@pytest.mark.parametrize("lamp", ["rectangle", "environment"])
def test_gaussians_without_shadows_on_meshes_keep_no_light_off_them(lamp: str, tmp_path: Path) -> None:
    write_exr(tmp_path / "even.exr", {channel: np.full((4, 8), 0.5, np.float32) for channel in "RGB"})
    rectangle = RectangleLight(position=(0, 0, -1), direction=(0, 0, 1), width=4, height=4, radiance=0.5)
    lights: dict[str, object] = {"lights": (rectangle,)}
    if lamp == "environment":
        lights = {"environment": Environment(file="even.exr")}
    screen = StageMesh(
        shape="cube", scale=(9, 9, 1), position=(0, 0, 2), material=Diffuse(color_srgb=(1, 1, 1))
    )
    numbers = Integrator(samples=64, max_depth=2, anti_aliasing=False)
    view = camera((-2, 0, 0.5), (0, 0, 1), (5, 5), 1)

    def lit(**more: bool) -> float:
        """Light on the screen behind a black wall of Gaussians that is as large as it."""
        stage = Stage(
            gaussians=(StageGaussians(light="emissive", **more),), meshes=(screen,), integrator=numbers,
            **lights,
        )  # fmt: skip
        return float(srgb_to_linear(picture(stage, view, wall(0.0, 9.0, color=0.0), tmp_path)).mean())

    alone = Stage(gaussians=(), meshes=(screen,), integrator=numbers, **lights)
    free = film_of(alone, view, tmp_path).image().rgb_linear.mean()
    assert free > 0.2 and lit() < 0.02
    assert lit(shadows_on_meshes=False) == pytest.approx(free, rel=0.02)


def picture_without(stage: Stage, view: PinholeCamera) -> np.ndarray:
    scene = PathTracerScene(compile_meshes(stage, Path()), None)
    return PathTracer(scene, stage.integrator).render(view.rays()).image().rgb_srgb


def test_thin_gaussians_cast_thin_shadows() -> None:
    floor = StageMesh(shape="plane", position=(0, 1, 0), scale=9, material=Diffuse(color_srgb=(1, 1, 1)))
    sun = DirectionalLight(direction=(0, 1, 0), irradiance=np.pi)
    one = FlatGaussians(
        np.zeros((1, 3), np.float32), np.float32([[np.sqrt(0.5), 0, 0, np.sqrt(0.5)]]),
        np.zeros((1, 2), np.float32), np.zeros(1, np.float32), np.full((1, 1, 3), -0.5 / SH_C0, np.float32),
    )  # fmt: skip
    numbers = Integrator(samples=1, max_depth=1, anti_aliasing=False)
    # Under the middle of a Gaussian of opacity one half, half of the light arrives.
    view = camera((-3, 0.9, 0), (0, 1, 0), (3, 3), 1e-3)
    shown = picture(emissive(floor, numbers=numbers, lights=(sun,)), view, one)
    linear = ((shown.mean() + 0.055) / 1.055) ** 2.4
    assert abs(linear - 0.5) < 0.01


def test_meshes_take_the_light_of_shadowed_gaussians_away_and_no_more() -> None:
    screen = wall(0.0, 2.0)
    half = StageMesh(shape="cube", scale=(1, 1, 0.01), position=(-1, 0, -1), material=Diffuse())
    sun = DirectionalLight(direction=(0, 0, 1), irradiance=5)
    numbers = Integrator(samples=4, max_depth=1, anti_aliasing=False)
    # Seen from the side, so that the plate itself is not in the way.
    view = camera((2.0, 0, -0.8), (-0.3, 0, 0), (41, 5), 12)
    stage = Stage(
        gaussians=(StageGaussians(light="shadowed", ambient=0.25),),
        meshes=(half,),
        lights=(sun,),
        integrator=numbers,
    )
    lit = plainly(screen, view)
    shown = picture(stage, view, screen)
    linear = [((x + 0.055) / 1.055) ** 2.4 for x in (shown, lit)]
    ratio = (linear[0] / linear[1])[2, :, 0]
    # On the right the wall is as trained, in the plate's shadow a quarter of it is left.
    assert abs(ratio[-5:].mean() - 1) < 1e-3
    shadow = ratio[(ratio < 0.5)]
    assert len(shadow) > 3 and abs(np.median(shadow) - 0.25) < 0.01


def test_relit_gaussians_match_diffuse_wall() -> None:
    screen = wall(0.0, 2.0, color=0.6)
    lamp = PointLight(position=(0.5, -0.5, -1.5), intensity=4)
    numbers = Integrator(samples=1, max_depth=1, anti_aliasing=False)
    view = camera((0.4, 0.3, -2.5), (0, 0, 0), (24, 18), 30)
    board = StageMesh(
        shape="cube", scale=(2, 2, 0.01), position=(0, 0, 0.01), material=Diffuse(color_srgb=(0.6, 0.6, 0.6))
    )
    as_mesh = picture_without(Stage(gaussians=(), meshes=(board,), lights=(lamp,), integrator=numbers), view)
    stage = Stage(gaussians=(StageGaussians(light="relit", ambient=0.0),), lights=(lamp,), integrator=numbers)
    assert psnr(picture(stage, view, screen), as_mesh) > 40
    lighter = stage.model_copy(
        update={"gaussians": (StageGaussians(light="relit", ambient=1.0),), "lights": ()}
    )
    assert psnr(picture(lighter, view, screen), plainly(screen, view)) > 50


def test_gaussians_light_mesh_as_equivalent_wall(tmp_path: Path) -> None:
    # A matt ball within a bright wall of Gaussians on one side, and the same light as an area light.
    screen = wall(-1.5, 1.0, per_side=120, color=0.9)
    floor = StageMesh(
        shape="plane", rotation_degrees=(-90, 0, 0), scale=3, material=Diffuse(color_srgb=(1, 1, 1))
    )
    numbers = Integrator(samples=1024, max_depth=1, anti_aliasing=False)
    view = camera((2.0, 0, -0.8), (0, 0, 0), (5, 4), 5)
    radiance = ((0.9 + 0.055) / 1.055) ** 2.4
    lamp = RectangleLight(position=(0, 0, -1.5), direction=(0, 0, 1), width=2, height=2, radiance=radiance)
    by_lamp = picture_without(Stage(gaussians=(), meshes=(floor,), lights=(lamp,), integrator=numbers), view)
    by_gaussians = picture(emissive(floor, numbers=numbers), view, screen)
    assert by_lamp.mean() > 0.2
    # The wall's rim is soft and stands out by the width of a Gaussian.
    assert abs(by_gaussians.mean() / by_lamp.mean() - 1) < 0.03


def test_several_scenes_each_in_its_place_and_light(tmp_path: Path) -> None:
    some = cloud(100, spread=0.3)
    stage = Stage(
        gaussians=(
            StageGaussians(light="emissive", position=(-0.6, 0, 0)),
            StageGaussians(
                light="relit", ambient=0.5, position=(0.6, 0, 0), scale=0.5, rotation_degrees=(0, 0, 180)
            ),
        ),
        integrator=PLAIN,
    )
    shown = picture(stage, VIEW, some)
    moved = FlatGaussians(some.means_world - np.float32([0.6, 0, 0]), *list(vars(some).values())[1:5])
    left = plainly(moved, VIEW)
    assert psnr(shown[:, :22], left[:, :22]) > 60
    assert shown[:, 26:].max() > 0.1


def test_hidden_environment_is_visible_in_mirror(tmp_path: Path) -> None:
    write_exr(tmp_path / "sky.exr", {c: np.full((8, 16), 0.7, np.float32) for c in "RGB"})
    ball = StageMesh(shape="sphere", scale=0.5, smooth_degrees=180, material=Mirror())
    stage = emissive(ball, environment=Environment(file="sky.exr", visible=False))
    shown = picture(stage, VIEW, cloud(1, centre=(9, 9, 9)), tmp_path)
    assert shown[0, 0, 0] == 0 and abs(shown[18, 24, 0] - 1.055 * 0.7 ** (1 / 2.4) + 0.055) < 1e-3


@pytest.mark.parametrize("clamp", [None, 0.5])
def test_clamp_limits_what_matt_surfaces_see_of_lit_gaussians(clamp: float | None) -> None:
    board = StageMesh(shape="plane", position=(0, 0.6, 0), scale=3, material=Diffuse(color_srgb=(1, 1, 1)))
    lamp = PointLight(position=(0, 0.3, 0), intensity=5, lights_meshes=False)
    numbers = Integrator(samples=1, max_depth=1, clamp=clamp)
    lit = StageGaussians(light="relit", ambient=0.0)
    stage = Stage(gaussians=(lit,), meshes=(board,), lights=(lamp,), integrator=numbers)
    view = camera((0, 0.1, -3), (0, 0.6, 0), (16, 8), 20)
    brightest = srgb_to_linear(picture(stage, view, table_with_a_box()).max(keepdims=True)).max()
    assert (brightest > 0.9) if clamp is None else (brightest <= clamp + 1e-4)


def test_gaussian_render_is_independent_of_threads() -> None:
    some = cloud(400)
    meshes = (
        StageMesh(shape="plane", scale=3, position=(0, 0.8, 0)),
        StageMesh(shape="sphere", scale=0.4, smooth_degrees=180, material=Glass()),
    )
    sun = DirectionalLight(direction=(1, 2, 1), irradiance=1.0)
    numbers = Integrator(samples=8, max_depth=5)
    stage = Stage(gaussians=(StageGaussians(),), meshes=meshes, lights=(sun,), integrator=numbers)
    one = picture(stage, VIEW, some, threads=1)
    assert one.tobytes() == picture(stage, VIEW, some, threads=2).tobytes()
