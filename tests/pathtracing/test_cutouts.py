"""Surfaces with holes: what paths see through them, the shadows that they cast, and files that have them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octasplat.engine.pathtracing.compile_meshes import compile_meshes
from octasplat.engine.pathtracing.mesh_shapes import primitive_shape
from octasplat.engine.pathtracing.stage.materials import Dielectric, Diffuse, MetallicRoughness
from octasplat.engine.pathtracing.stage.model import (
    DirectionalLight,
    Environment,
    Integrator,
    RectangleLight,
    Stage,
    StageGaussians,
    StageMesh,
)
from octasplat.engine.render.image_files import write_exr, write_png
from tests.pathtracing.test_gaussians import picture, plainly, wall
from tests.pathtracing.test_mesh_material import Y_UP, write_glb, write_obj
from tests.support.light_scenes import camera, film_of

AHEAD = camera((0, 0, -4), (0, 0, 0), (12, 8), 20)
DIRECT = Integrator(samples=4, max_depth=1, anti_aliasing=False)
WHITE = (1.0, 1.0, 1.0)
FLOOR = StageMesh(shape="plane", position=(0, 1, 0), scale=9, material=Diffuse(color_srgb=WHITE))
BELOW = camera((-3, 0.5, 0), (0, 1, 0), (3, 3), 1e-3)
"""Sees the floor's middle from below all panes."""


def panes(count: int, opacity: float) -> tuple[StageMesh, ...]:
    """Black panes one above the other."""
    gauze = Diffuse(color_srgb=(0, 0, 0), opacity=opacity)
    return tuple(
        StageMesh(shape="plane", position=(0, -1 - 0.25 * k, 0), scale=6, material=gauze)
        for k in range(count)
    )


def test_paths_pass_each_pane_by_its_opacity(tmp_path: Path) -> None:
    gauze = Diffuse(color_srgb=(0, 0, 0), opacity=0.3)
    # More panes than a path may meet surfaces: what is passed is not counted.
    layers = tuple(
        StageMesh(
            shape="plane", rotation_degrees=(90, 0, 0), position=(0, 0, 0.2 * k), scale=9, material=gauze
        )
        for k in range(4)
    )
    numbers = Integrator(samples=4096, max_depth=1, anti_aliasing=False)
    stage = Stage(gaussians=(), meshes=layers, integrator=numbers)
    seen = film_of(stage, AHEAD, tmp_path, background=1.0).image().rgb_linear
    assert seen.mean() == pytest.approx(0.7**4, rel=5e-3)


@pytest.mark.parametrize("extent", [0.0, 0.8])
def test_shadow_of_panes_is_the_product_of_what_they_let_through(extent: float) -> None:
    lamp: Any = DirectionalLight(direction=(0, 1, 0), irradiance=np.pi)
    if extent:
        lamp = RectangleLight(
            position=(0, -9, 0), direction=(0, 1, 0), width=extent, height=extent, radiance=100
        )

    def lit(*meshes: StageMesh) -> float:
        stage = Stage(gaussians=(), meshes=(FLOOR, *meshes), lights=(lamp,), integrator=DIRECT)
        return float(film_of(stage, BELOW).image().rgb_linear.mean())

    free = lit()
    assert free > 0.1 and (extent or free == pytest.approx(1.0, rel=1e-5))
    for count, opacity in ((1, 0.25), (20, 0.25), (1, 1.0)):
        assert lit(*panes(count, opacity)) == pytest.approx(free * (1 - opacity) ** count, rel=1e-4, abs=1e-6)


def test_white_ball_of_gauze_cannot_be_seen_in_white_surroundings(tmp_path: Path) -> None:
    write_exr(tmp_path / "white.exr", {c: np.ones((8, 16), np.float32) for c in "RGB"})
    for material in (Diffuse(color_srgb=WHITE, opacity=0.4), Dielectric(color_srgb=WHITE, opacity=0.7)):
        ball = StageMesh(shape="sphere", smooth_degrees=180, material=material)
        stage = Stage(
            gaussians=(), meshes=(ball,), environment=Environment(file="white.exr"),
            integrator=Integrator(samples=64, max_depth=32, roulette_depth=32),
        )  # fmt: skip
        assert film_of(stage, AHEAD, tmp_path).image().rgb_linear.mean() == pytest.approx(1.0, abs=0.01)


def test_what_is_not_there_does_not_shine() -> None:
    def irradiance(opacity: float, depth: int) -> float:
        lamp = StageMesh(
            shape="plane", position=(0, -1, 0), scale=0.7,
            material=Diffuse(color_srgb=(0, 0, 0), emission=2.0, opacity=opacity),
        )  # fmt: skip
        numbers = Integrator(samples=4096, max_depth=depth, anti_aliasing=False)
        stage = Stage(gaussians=(), meshes=(FLOOR, lamp), integrator=numbers)
        return float(film_of(stage, BELOW).image().rgb_linear.mean())

    # Alone by asking for the lamp, and also by paths that run into it.
    for depth in (1, 2):
        assert irradiance(0.35, depth) == pytest.approx(0.35 * irradiance(1.0, depth), rel=0.02)


@pytest.mark.exhaustive
def test_shadow_of_gauze_on_gaussians_is_its_opacity() -> None:
    screen = wall(0.0, 2.0)
    sun = DirectionalLight(direction=(0, 0, 1), irradiance=5)
    view = camera((2.0, 0, -0.8), (-0.3, 0, 0), (41, 5), 12)
    gauze = StageMesh(
        shape="plane", rotation_degrees=(90, 0, 0), position=(-1, 0, -1), material=Diffuse(opacity=0.6)
    )
    stage = Stage(
        gaussians=(StageGaussians(light="shadowed", ambient=0.25),), meshes=(gauze,), lights=(sun,),
        integrator=DIRECT,
    )  # fmt: skip
    lit, shown = (((x + 0.055) / 1.055) ** 2.4 for x in (plainly(screen, view), picture(stage, view, screen)))
    ratio = (shown / lit)[2, :, 0]
    assert abs(ratio[-5:].mean() - 1) < 1e-3
    assert np.median(ratio[ratio < 0.8]) == pytest.approx(1 - 0.6 * 0.75, abs=0.01)


def leaf(folder: Path, alpha: float) -> bytes:
    rgb = np.full((4, 4, 3), 0.7, np.float32)
    write_png(folder / "leaf.png", rgb, np.full((4, 4), alpha, np.float32))
    return (folder / "leaf.png").read_bytes()


def staged(folder: Path, *meshes: StageMesh, samples: int = 4) -> np.ndarray:
    stage = Stage(
        up=Y_UP, gaussians=(), meshes=meshes, lights=(DirectionalLight(direction=(0, -1, 0), irradiance=3),),
        integrator=Integrator(samples=samples, max_depth=3),
    )  # fmt: skip
    view = camera((0.3, 3, 1e-3), (0, 0, 0), (12, 8), 20)
    return film_of(stage, view, folder, background=0.3).image().rgb_linear


def test_glb_alpha_mask_is_there_or_not(tmp_path: Path) -> None:
    ground = StageMesh(shape="plane", position=(0, -1, 0), material=Diffuse())
    plane = primitive_shape("plane")
    shading = {"baseColorTexture": {"index": 0}, "metallicFactor": 0, "baseColorFactor": [1, 1, 1, 0.5]}
    for alpha, cutoff, is_there in ((0.9, None, False), (0.9, 0.4, True), (1.0, None, True)):
        mask: dict[str, Any] = {"pbrMetallicRoughness": shading, "alphaMode": "MASK"}
        mask |= {} if cutoff is None else {"alphaCutoff": cutoff}
        write_glb(tmp_path / "leaf.glb", plane, [mask], [leaf(tmp_path, alpha)])
        # opaque materials have no alpha, whatever their images hold
        write_glb(
            tmp_path / "opaque.glb", plane, [{"pbrMetallicRoughness": shading}], [leaf(tmp_path, alpha)]
        )
        found = staged(tmp_path, ground, StageMesh(file="leaf.glb"))
        others = (StageMesh(file="opaque.glb"),) if is_there else ()
        np.testing.assert_array_equal(found, staged(tmp_path, ground, *others))


def test_glb_blend_and_obj_opacity_cover_by_their_alpha(tmp_path: Path) -> None:
    plane = primitive_shape("plane")
    blend = {
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0}, "baseColorFactor": [1, 1, 1, 0.5], "metallicFactor": 0,
        },
        "alphaMode": "BLEND",
    }  # fmt: skip
    write_glb(tmp_path / "a.glb", plane, [blend], [leaf(tmp_path, 0.8)])
    alpha = 0.5 * round(0.8 * 255) / 255
    twin = MetallicRoughness(texture="leaf.png", opacity=0.5, opacity_texture="leaf.png")
    write_obj(tmp_path / "a.obj", plane, "mtllib a.mtl\nusemtl m")
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd leaf.png\nmap_d leaf.png\nd 0.5\n")
    # 1024 samples: the opacity is met on average
    covered, free = (
        staged(tmp_path, StageMesh(file="a.glb", material=m), samples=1024)
        for m in (MetallicRoughness(texture="leaf.png"), MetallicRoughness(opacity=0.0))
    )
    for mesh in (
        StageMesh(file="a.glb"),
        StageMesh(file="a.glb", material=twin),
        StageMesh(file="a.obj", up_axis="y"),
    ):
        found = staged(tmp_path, mesh, samples=1024)
        np.testing.assert_allclose(found.mean(), (alpha * covered + (1 - alpha) * free).mean(), rtol=5e-3)


BLACK_BLEND = {
    "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1], "metallicFactor": 0},
    "alphaMode": "BLEND",
    # nothing is reflected
    "extensions": {"KHR_materials_ior": {"ior": 1.0}},
}


ACROSS = -(np.arange(40) - 19.5) / 2 * 4 * np.tan(np.radians(2))
"""x of the pixels of 40 x 4 that see 4 degrees from 4 units above."""


def over_white(folder: Path, name: str, samples: int = 1024) -> np.ndarray:
    """What a mesh of black shows before white, in darkness: a row along ``ACROSS``, seen from above."""
    stage = Stage(
        up=Y_UP, gaussians=(), meshes=(StageMesh(file=name),),
        integrator=Integrator(samples=samples, max_depth=2, anti_aliasing=False),
    )  # fmt: skip
    view = camera((0.0, 4, 1e-3), (0, 0, 0), (40, 4), 4)
    return film_of(stage, view, folder, background=1.0).image().rgb_linear[..., 0].mean(axis=0)


def rgba_of(alpha: Any) -> np.ndarray:
    """Colors of the plane's four corners."""
    return np.concatenate([np.ones((4, 3)), np.broadcast_to(alpha, 4)[:, None]], axis=1).astype(np.float32)


def test_glb_vertex_alpha_blends_as_factor_and_texture_do(tmp_path: Path) -> None:
    plane = primitive_shape("plane")
    write_glb(tmp_path / "half.glb", plane, [BLACK_BLEND], colors=rgba_of(0.5))
    inside = np.abs(ACROSS) < 0.9
    assert over_white(tmp_path, "half.glb")[inside].mean() == pytest.approx(0.5, abs=5e-3)
    # base color factor x texture x vertex color
    shading = {"baseColorFactor": [0, 0, 0, 0.5], "metallicFactor": 0, "baseColorTexture": {"index": 0}}
    write_glb(
        tmp_path / "all.glb", plane, [BLACK_BLEND | {"pbrMetallicRoughness": shading}],
        [leaf(tmp_path, 0.8)], colors=rgba_of(0.5),
    )  # fmt: skip
    assert over_white(tmp_path, "all.glb")[inside].mean() == pytest.approx(1 - 0.5 * 0.8 * 0.5, abs=5e-3)
    # opaque materials have no alpha, whatever their vertices hold
    opaque = {key: value for key, value in BLACK_BLEND.items() if key != "alphaMode"}
    write_glb(tmp_path / "opaque.glb", plane, [opaque], colors=rgba_of(0.5))
    assert over_white(tmp_path, "opaque.glb")[inside].max() < 1e-6


def test_glb_vertex_alpha_is_interpolated_and_cut(tmp_path: Path) -> None:
    plane = primitive_shape("plane")
    # corners at x = -1, 1, 1, -1
    ramp = rgba_of([0.0, 1.0, 1.0, 0.0])
    write_glb(tmp_path / "ramp.glb", plane, [BLACK_BLEND], colors=ramp)
    seen = over_white(tmp_path, "ramp.glb", 4096)
    within = np.abs(ACROSS) < 1
    np.testing.assert_allclose(seen, np.where(within, 1 - (ACROSS + 1) / 2, 1.0), atol=0.03)
    write_glb(tmp_path / "cut.glb", plane, [BLACK_BLEND | {"alphaMode": "MASK"}], colors=ramp)
    seen = over_white(tmp_path, "cut.glb", 4)
    np.testing.assert_allclose(seen, np.where(within & (ACROSS > 0), 0.0, 1.0), atol=1e-6)


def test_glb_vertex_alpha_casts_its_share_of_shadow_and_light(tmp_path: Path) -> None:
    plane = primitive_shape("plane")
    ground = StageMesh(shape="plane", position=(0, -1, 0), scale=9, material=Diffuse(color_srgb=WHITE))
    below = camera((-3, -0.5, 0), (0, -1, 0), (3, 3), 1e-3)

    def lit(name: str, *lights: Any, samples: int = 4) -> float:
        stage = Stage(
            up=Y_UP, gaussians=(), meshes=(ground, StageMesh(file=name)), lights=lights,
            integrator=Integrator(samples=samples, max_depth=1, anti_aliasing=False),
        )  # fmt: skip
        return float(film_of(stage, below, tmp_path).image().rgb_linear.mean())

    sun = DirectionalLight(direction=(0, -1, 0), irradiance=np.pi)
    for alpha in (0.0, 0.3, 1.0):
        write_glb(tmp_path / "a.glb", plane, [BLACK_BLEND], colors=rgba_of(alpha))
        assert lit("a.glb", sun) == pytest.approx(1 - alpha, abs=1e-5)
    # what is not there does not shine
    shining = BLACK_BLEND | {"emissiveFactor": [1, 1, 1]}
    found = []
    for alpha in (0.3, 1.0):
        write_glb(tmp_path / "a.glb", plane, [shining], colors=rgba_of(alpha))
        found.append(lit("a.glb", samples=1024))
    assert found[1] > 0.1 and found[0] == pytest.approx(0.3 * found[1], rel=0.02)


def test_opacity_texture_without_alpha_is_its_grey_unless_it_is_the_color(tmp_path: Path) -> None:
    write_png(tmp_path / "grey.png", np.full((2, 2, 3), 0.6, np.float32))
    write_png(tmp_path / "color.png", np.full((2, 2, 3), 0.6, np.float32))
    for name, opacity in (("grey.png", 0.6), ("color.png", 1.0)):
        material = Diffuse(texture="color.png", opacity_texture=name)
        compiled = compile_meshes(Stage(meshes=(StageMesh(shape="plane", material=material),)), tmp_path)
        first = compiled.materials.texture_sizes[compiled.materials.opacity_textures[0], 0]
        assert compiled.materials.texels_linear[first, 0] == pytest.approx(opacity, abs=1e-6)
