"""Gaussians with materials on stages: surfaces as meshes of the same material are, for every ray."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians
from octasplat.engine.pathtracing.compile_meshes import compile_meshes
from octasplat.engine.pathtracing.gaussian_layers import build_gaussian_layers
from octasplat.engine.pathtracing.path_tracer import PathTracer, PathTracerScene
from octasplat.engine.pathtracing.stage.materials import MetallicRoughness, Mirror
from octasplat.engine.pathtracing.stage.model import (
    DirectionalLight,
    Environment,
    Integrator,
    Stage,
    StageGaussians,
    StageMesh,
)
from octasplat.engine.render.environment_files import write_environment
from octasplat.engine.trace.protocol import TraceSettings
from tests.support.light_scenes import camera, psnr, shiny_ball

FOLDER = Path(__file__).parent


def sky(folder: Path, *, white: bool = False) -> str:
    """A smooth environment with a bright side, or one that is white everywhere."""
    v, u = np.mgrid[0:16, 0:32] / 16.0
    light = 0.7 + 0.3 * np.cos(u * np.pi)[..., None] * [1.0, 0.5, 0.2] + 0.3 * np.cos(v * np.pi)[..., None]
    write_environment(folder / "sky.exr", (np.ones_like(light) if white else light).astype(np.float32))
    return str(folder / "sky.exr")


def picture(
    stage: Stage,
    gaussians: FlatGaussians | None,
    side: int = 24,
    threads: int = 2,
    files: dict[str, FlatGaussians] | None = None,
) -> np.ndarray:
    layers = build_gaussian_layers(
        stage,
        gaussians,
        lambda path: (files or {})[path.name],
        FOLDER,
        TraceSettings(),
        size=1.0,
        threads=threads,
    )
    scene = PathTracerScene(compile_meshes(stage, FOLDER, threads=threads), layers, np.zeros(3))
    view = camera((0, 0, -3.2), (0, 0, 0), (side, side), 45.0)
    film = PathTracer(scene, stage.integrator, threads=threads).render(view.rays())
    return film.image().rgb_srgb


def both(
    environment: str, material: dict, more: dict | None = None, samples: int = 64
) -> tuple[np.ndarray, ...]:
    """The same ball as Gaussians and as a mesh, with the same material, in the same light."""
    settings = Integrator(samples=samples, max_depth=4)
    light = Environment(file=environment, visible=False)
    given = {"up": (0.0, -1.0, 0.0), "environment": light, "integrator": settings, **(more or {})}
    meshes = given.pop("meshes", ())
    albedo, metallic, roughness = material["albedo"], material["metallic"], material["roughness"]
    gaussians = shiny_ball(3000, 1.0, albedo=albedo, metallic=metallic, roughness=roughness)
    ours = Stage(gaussians=(StageGaussians(light="relit"),), meshes=meshes, **given)
    color = tuple(float(c) for c in linear_to_srgb(np.array(albedo)))
    solid = MetallicRoughness(
        color_srgb=color,
        metallic=metallic,
        roughness=roughness,
        diffuse="burley",
        multiple_scattering=False,
    )
    mesh = StageMesh(shape="sphere", material=solid)
    theirs = Stage(gaussians=(), meshes=(mesh, *meshes), **given)
    return picture(ours, gaussians), picture(theirs, None)


@pytest.mark.parametrize(
    ("metallic", "roughness", "least"), [(1.0, 0.15, 33.0), (0.0, 0.3, 36.0), (0.5, 0.6, 36.0)]
)
def test_gaussian_ball_matches_mesh_ball(tmp_path, metallic, roughness, least):
    material = {"albedo": (0.8, 0.5, 0.2), "metallic": metallic, "roughness": roughness}
    ours, theirs = both(sky(tmp_path), material)
    inside = np.s_[7:17, 7:17]  # the outline of a ball of Gaussians is soft
    assert theirs[inside].std() > 0.01
    assert psnr(ours[inside], theirs[inside]) > least
    assert abs(float(ours[inside].mean() / theirs[inside].mean()) - 1) < 0.02


def test_mirror_and_gaussians_reflect_each_other(tmp_path):
    material = {"albedo": (0.9, 0.9, 0.9), "metallic": 1.0, "roughness": 0.2}
    mirror = StageMesh(
        shape="plane", position=(0, 1.3, 0), scale=3.0, material=Mirror(color_srgb=(0.9, 0.9, 0.9))
    )
    box = StageMesh(
        shape="cube",
        position=(1.3, -0.3, -0.9),
        scale=0.25,
        material=MetallicRoughness(color_srgb=(0.9, 0.1, 0.1)),
    )
    ours, theirs = both(sky(tmp_path), material, {"meshes": (mirror, box)})
    assert psnr(ours, theirs) > 24
    assert psnr(ours[9:16, 9:16], theirs[9:16, 9:16]) > 30


def test_material_gaussians_white_furnace_conserves_energy(tmp_path):
    """Smooth metal that reflects everything is nearly white in white light, and never brighter."""
    environment = Environment(file=sky(tmp_path, white=True), visible=True)
    gaussians = shiny_ball(2000, 1.0, albedo=(1.0, 1.0, 1.0), metallic=1.0, roughness=0.2)
    stage = Stage(
        gaussians=(StageGaussians(light="relit"),), environment=environment,
        integrator=Integrator(samples=64, max_depth=6),
    )  # fmt: skip
    image = picture(stage, gaussians)
    assert image.max() <= 1.0 + 1e-6 and image[9:16, 9:16].mean() > 0.985


def test_material_render_independent_of_threads_and_colors(tmp_path):
    gaussians = shiny_ball(1500, 1.0, albedo=(0.5, 0.5, 0.5), metallic=0.5, roughness=0.3)
    stage = Stage(
        gaussians=(StageGaussians(light="relit"),),
        environment=Environment(file=sky(tmp_path), visible=False),
        integrator=Integrator(samples=4, max_depth=3),
    )
    first = picture(stage, gaussians, threads=1)
    colored = shiny_ball(1500, 1.0, albedo=(0.5, 0.5, 0.5), metallic=0.5, roughness=0.3)
    colored.sh[:] = 1.0
    assert (picture(stage, colored, threads=2) == first).all()


def test_new_lamps_light_what_is_seen_through_material_gaussians_as_what_is_beside_them():
    """A lamp adds as much to a wall behind a veil with materials as without the veil, which reflects none."""
    x, y = (2.0 * part.ravel() for part in np.mgrid[-1:1:41j, -1:1:41j])
    quats = np.tile(np.float32([np.sqrt(0.5), 0, -np.sqrt(0.5), 0]), (len(x), 1))  # the normal along z
    wall, veil = (
        FlatGaussians(
            np.stack([x, y, np.full(len(x), z)], axis=1).astype(np.float32),
            quats,
            np.full((len(x), 2), np.log(0.1), np.float32),
            np.full(len(x), logit, np.float32),
            np.full((len(x), 1, 3), -0.2 / SH_C0, np.float32),
        )
        for z, logit in ((0.5, 12.0), (-0.5, -1.5))
    )
    black = {"albedo": np.zeros((len(x), 3)), "metallic": np.zeros((len(x), 1))}
    smooth = {"roughness": np.full((len(x), 1), 0.05)}
    veil = veil.with_channels({k: v.astype(np.float32) for k, v in {**black, **smooth}.items()})
    lamp = DirectionalLight(direction=(0, 1, 1), irradiance=3.0, adds_light=True)
    through = StageGaussians(light="shadowed", ambient=1.0), StageGaussians(file="veil.ply", light="relit")

    def shown(gaussians: tuple[StageGaussians, ...], *lights: DirectionalLight) -> np.ndarray:
        settings = Integrator(samples=256, max_depth=1, anti_aliasing=False)
        stage = Stage(gaussians=gaussians, lights=lights, integrator=settings)
        return picture(stage, wall, side=8, files={"veil.ply": veil})[2:6, 2:6]

    free, veiled = (shown(scenes, lamp) / shown(scenes) for scenes in (through[:1], through))
    assert free.mean() > 1.2 and 0.2 < shown(through).mean() / shown(through[:1]).mean() < 0.8
    np.testing.assert_allclose(veiled, free, rtol=0.01)
