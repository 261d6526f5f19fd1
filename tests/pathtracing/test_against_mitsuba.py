"""The same scenes without Gaussians in Mitsuba 3: the pictures are equal within the noise of both.

Mitsuba draws the very triangles of ours, with the same normals. How much noise each picture has is measured
on two halves of its samples; the difference between the two programs may hold no more than their noise.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octasplat.engine.pathtracing.compile_meshes import compile_meshes
from octasplat.engine.pathtracing.environment import environment_frame
from octasplat.engine.pathtracing.stage.materials import (
    Dielectric,
    Diffuse,
    Glass,
    Metal,
    MetallicRoughness,
    Mirror,
)
from octasplat.engine.pathtracing.stage.model import (
    DirectionalLight,
    Environment,
    Integrator,
    PointLight,
    RectangleLight,
    Stage,
    StageMesh,
)
from octasplat.engine.render.image_files import write_exr, write_png
from tests.support.daily import some_daily
from tests.support.light_scenes import camera, film_of

mi = pytest.importorskip("mitsuba")
pytestmark = pytest.mark.heavy

SIZE = (40, 30)
BOUNCES = 6
EYE = ((0.0, -1.6, -5.0), (0.0, -0.7, 0.0))
VIEW = camera(*EYE, SIZE, 40)
LAMP = RectangleLight(
    position=(-1.0, -3.5, -1.0), direction=(0.25, 1, 0.25), width=1.5, height=1.5, radiance=9
)
FLOOR = StageMesh(shape="plane", scale=4, material=Diffuse(color_srgb=(0.7, 0.6, 0.5)))


def ball(material: Any, radius: float = 0.9) -> StageMesh:
    return StageMesh(
        shape="sphere", position=(0, -radius, 0), scale=radius, smooth_degrees=180, material=material
    )


def linear(*srgb: float) -> dict[str, Any]:
    values = np.array(srgb)
    return {"type": "rgb", "value": (((values + 0.055) / 1.055) ** 2.4).tolist()}


GROUND = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": linear(0.7, 0.6, 0.5)}}


def lamp() -> dict[str, Any]:
    return {"type": "area", "radiance": {"type": "rgb", "value": 9.0}}


def environment(folder: Path) -> np.ndarray:
    """A smooth sky with a sun that is no point, so that how pixels are interpolated does not matter."""
    rows, columns = 128, 256
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
    y, around = np.cos(np.pi * v), 2 * np.pi * (u - 0.5)
    x, z = -np.sin(np.pi * v) * np.sin(around), np.sin(np.pi * v) * np.cos(around)
    sun = np.exp(20 * ((x * 0.5 + y * 0.7 - z * 0.5) / np.sqrt(0.99) - 1))
    sky = np.stack([0.3 + 0.2 * y + 12 * sun, 0.35 + 0.2 * y + 10 * sun, 0.5 + 0.3 * y + 7 * sun], axis=-1)
    sky = np.maximum(sky, 0.05).astype(np.float32)
    write_exr(folder / "sky.exr", {c: np.ascontiguousarray(sky[..., k]) for k, c in enumerate("RGB")})
    return sky


def mitsuba_scene(
    stage: Stage,
    folder: Path,
    bsdfs: list[dict[str, Any]],
    emitters: dict[str, Any],
    variant: str = "scalar_rgb",
    size: tuple[int, int] = SIZE,
    eye: tuple[tuple[float, ...], tuple[float, ...]] = EYE,
    depth: int = BOUNCES,
) -> Any:
    mi.set_variant(variant)
    surfaces = compile_meshes(stage, folder, threads=2).surfaces
    t = mi.ScalarTransform4f
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": depth + 1, "rr_depth": 100, "hide_emitters": False},
        "sensor": {
            "type": "perspective", "fov": 40, "fov_axis": "y",
            "to_world": t().look_at(origin=list(eye[0]), target=list(eye[1]), up=[0, -1, 0]),
            "film": {"type": "hdrfilm", "width": size[0], "height": size[1], "rfilter": {"type": "box"}},
            "sampler": {"type": "independent"},
        },
        **emitters,
    }  # fmt: skip
    for row, bsdf in enumerate(bsdfs):
        chosen = surfaces.material_ids == row
        corners = surfaces.corners_world[chosen].reshape(-1, 3)
        normals = surfaces.corner_normals[chosen].reshape(-1, 3)
        uv = surfaces.corner_uv[chosen].reshape(-1, 2)
        path = folder / f"part{row}.ply"
        with path.open("wb") as handle:
            names = "".join(f"property float {n}\n" for n in ("x", "y", "z", "nx", "ny", "nz", "u", "v"))
            head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(corners)}\n{names}"
            head += f"element face {len(corners) // 3}\nproperty list uchar int vertex_indices\nend_header\n"
            handle.write(head.encode())
            handle.write(np.hstack([corners, normals, uv]).astype("<f4").tobytes())
            faces = np.zeros(len(corners) // 3, [("n", "u1"), ("i", "<i4", 3)])
            faces["n"], faces["i"] = 3, np.arange(len(corners)).reshape(-1, 3)
            handle.write(faces.tobytes())
        part: dict[str, Any] = {"type": "ply", "filename": str(path)}
        part["emitter" if bsdf["type"] == "area" else "bsdf"] = bsdf
        scene[f"part{row}"] = part
    return mi.load_dict(scene)


def same(
    stage: Stage, folder: Path, bsdfs: list[dict[str, Any]], emitters: dict[str, Any], spp: int = 64
) -> str:
    """Compare, on display values up to 1, and say how near the two are."""
    scene = mitsuba_scene(stage, folder, bsdfs, emitters)
    theirs = [np.array(mi.render(scene, spp=4 * spp, seed=seed)) for seed in (1, 2)]
    ours = []
    for seed in (1, 2):
        numbers = stage.integrator.model_copy(update={"seed": seed, "samples": spp})
        ours.append(
            film_of(stage.model_copy(update={"integrator": numbers}), VIEW, folder).image().rgb_linear
        )
    shown = [[np.clip(p, 0, 1) ** (1 / 2.2) for p in pair] for pair in (ours, theirs)]
    noise = [np.mean((a - b) ** 2) / 2 for a, b in shown]
    # Each mean of two has half the noise of one.
    difference = np.mean((np.mean(shown[0], axis=0) - np.mean(shown[1], axis=0)) ** 2)
    brightness = np.mean(np.clip(ours, 0, 1)) / np.mean(np.clip(theirs, 0, 1)) - 1
    found = [f"{-10 * np.log10(max(x, 1e-12)):.1f}" for x in (difference, noise[0] / 2, noise[1] / 2)]
    told = f"difference {found[0]} dB, noise {found[1]} and {found[2]} dB, brightness {brightness:+.4f}"
    assert difference < 1.5 * (noise[0] + noise[1]) / 2 + 1e-5, told
    assert abs(brightness) < 0.01, told
    return told


def stage_of(*meshes: StageMesh, lights: tuple[Any, ...] = (LAMP,), env: Environment | None = None) -> Stage:
    numbers = Integrator(samples=64, max_depth=BOUNCES, roulette_depth=64)
    return Stage(gaussians=(), meshes=meshes, lights=lights, environment=env, integrator=numbers)


OPAQUE = {
    "mirror": (Mirror(), {"type": "conductor", "material": "none"}),
    "metal": (
        Metal(color_srgb=(0.95, 0.8, 0.5), roughness=0.5, multiple_scattering=False),
        {"type": "principled", "base_color": linear(0.95, 0.8, 0.5), "metallic": 1.0, "roughness": 0.5},
    ),
    "rough mirror": (
        Metal(color_srgb=(1, 1, 1), roughness=0.7, multiple_scattering=False),
        {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": 0.49},
    ),
    "principled": (
        MetallicRoughness(
            color_srgb=(0.6, 0.3, 0.2), metallic=0.3, roughness=0.4,
            diffuse="burley", multiple_scattering=False,
        ),
        {"type": "principled", "base_color": linear(0.6, 0.3, 0.2), "metallic": 0.3, "roughness": 0.4},
    ),
    # A smooth coat: Mitsuba's rough one loses up to a fifth of what falls on white (alpha 0.16).
    "plastic": (
        Dielectric(color_srgb=(0.7, 0.2, 0.2), roughness=0.03),
        {"type": "plastic", "int_ior": 1.5, "ext_ior": 1.0, "diffuse_reflectance": linear(0.7, 0.2, 0.2)},
    ),
    "glass": (Glass(ior=1.5), {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}),
    "rough glass": (
        Glass(ior=1.5, roughness=0.5, multiple_scattering=False),
        {"type": "roughdielectric", "int_ior": 1.5, "ext_ior": 1.0, "distribution": "ggx", "alpha": 0.25},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", some_daily(OPAQUE, {"mirror", "plastic", "principled"}))
def test_sphere_under_area_light_matches_mitsuba(name: str, tmp_path: Path) -> None:
    material, bsdf = OPAQUE[name]
    if "dielectric" not in bsdf["type"]:
        bsdf = {"type": "twosided", "bsdf": bsdf} if bsdf["type"] != "principled" else bsdf
    print(name, same(stage_of(FLOOR, ball(material)), tmp_path, [GROUND, bsdf, lamp()], {}))  # noqa: T201


@pytest.mark.parametrize(
    "name", some_daily(["mirror", "metal", "principled", "glass", "rough glass"], {"metal", "rough glass"})
)
def test_sphere_under_environment_matches_mitsuba(name: str, tmp_path: Path) -> None:
    material, bsdf = OPAQUE[name]
    environment(tmp_path)
    # Mitsuba's map has y up and looks along +z in its middle, as a map with our frame for that up.
    assert np.allclose(environment_frame(np.array([0.0, 1.0, 0.0]))[2], [0, 0, 1])
    sky = {"type": "envmap", "filename": str(tmp_path / "sky.exr")}
    stage = stage_of(FLOOR, ball(material), lights=(), env=Environment(file="sky.exr"))
    turned = stage.model_copy(update={"up": (0.0, 1.0, 0.0)})
    print(name, same(turned, tmp_path, [GROUND, bsdf], {"sky": sky}))  # noqa: T201


@pytest.mark.exhaustive
def test_ball_of_glass_filled_with_water_matches_mitsuba(tmp_path: Path) -> None:
    environment(tmp_path)
    sky = {"type": "envmap", "filename": str(tmp_path / "sky.exr")}
    shell = Glass(ior=1.5, priority=1)
    inner = ball(Glass(ior=1.33, priority=2), 0.6).model_copy(update={"position": (0, -0.9, 0)})
    theirs = [
        {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0},
        {"type": "dielectric", "int_ior": 1.33, "ext_ior": 1.5},
    ]
    stage = stage_of(FLOOR, ball(shell), inner, lights=(), env=Environment(file="sky.exr"))
    turned = stage.model_copy(update={"up": (0.0, 1.0, 0.0)})
    print("filled", same(turned, tmp_path, [GROUND, *theirs], {"sky": sky}))  # noqa: T201


def test_textured_dielectric_matches_mitsuba(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    write_png(
        tmp_path / "checks.png", np.kron(rng.random((4, 4, 3)), np.ones((32, 32, 1))).astype(np.float32)
    )
    texture = {"type": "bitmap", "filename": str(tmp_path / "checks.png")}
    plain = {"type": "principled", "base_color": texture, "roughness": 0.3}
    material = MetallicRoughness(texture="checks.png", roughness=0.3, diffuse="burley")
    box = StageMesh(
        shape="cube", scale=0.7, position=(0, -0.7, 0), rotation_degrees=(0, 35, 0), material=material
    )
    print("textured", same(stage_of(FLOOR, box), tmp_path, [GROUND, plain, lamp()], {}))  # noqa: T201


def test_opacity_texture_matches_mitsuba(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    values = np.kron(rng.random((4, 4)), np.ones((32, 32)))
    write_png(tmp_path / "holes.png", np.repeat(values[..., None], 3, axis=2).astype(np.float32))
    texture = {"type": "bitmap", "filename": str(tmp_path / "holes.png"), "raw": True}
    red = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": linear(0.8, 0.2, 0.2)}}
    for cutoff in (None, 0.5):
        material = Diffuse(color_srgb=(0.8, 0.2, 0.2), opacity_texture="holes.png", opacity_cutoff=cutoff)
        box = StageMesh(
            shape="cube", scale=0.7, position=(0, -0.7, 0), rotation_degrees=(0, 35, 0), material=material
        )
        if cutoff is not None:
            # theirs has no cutoff: the image is cut before, and looked up without blending
            write_png(tmp_path / "holes.png", np.repeat((values >= 0.5)[..., None], 3, 2).astype(np.float32))
            texture["filter_type"] = "nearest"
        bsdf = {"type": "mask", "opacity": texture, "bsdf": red}
        print("holes", cutoff, same(stage_of(FLOOR, box), tmp_path, [GROUND, bsdf, lamp()], {}))  # noqa: T201


def test_point_and_directional_lights(tmp_path: Path) -> None:
    lights = (
        PointLight(position=(1, -3, -2), intensity=6),
        DirectionalLight(direction=(1, 2, 1), irradiance=0.7),
    )
    emitters = {
        "a": {"type": "point", "position": [1, -3, -2], "intensity": {"type": "rgb", "value": 6.0}},
        "b": {"type": "directional", "direction": [1, 2, 1], "irradiance": {"type": "rgb", "value": 0.7}},
    }
    red = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": linear(0.8, 0.2, 0.2)}}
    stage = stage_of(FLOOR, ball(Diffuse(color_srgb=(0.8, 0.2, 0.2))), lights=lights)
    print("points", same(stage, tmp_path, [GROUND, red], emitters))  # noqa: T201


@pytest.mark.exhaustive
def test_emissive_and_light_spheres_match_mitsuba(tmp_path: Path) -> None:
    glow = Diffuse(color_srgb=(0, 0, 0), emission=4.0)
    shining = StageMesh(
        shape="cube", scale=0.4, position=(-1, -1.5, 0), rotation_degrees=(20, 30, 0), material=glow
    )
    matt = ball(Diffuse(color_srgb=(0.8, 0.2, 0.2)), 0.6)
    lamp_ball = PointLight(position=(1.4, -1.8, -0.5), intensity=2.0, radius=0.3)
    red = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": linear(0.8, 0.2, 0.2)}}
    areas = [{"type": "area", "radiance": {"type": "rgb", "value": v}} for v in (4.0, 2.0 / (np.pi * 0.09))]
    stage = stage_of(FLOOR, matt, shining, lights=(lamp_ball,))
    print("shining", same(stage, tmp_path, [GROUND, red, *areas], {}))  # noqa: T201


def test_normal_texture_matches_mitsuba(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    slopes = np.kron(rng.uniform(0.25, 0.75, (4, 4, 2)), np.ones((16, 16, 1)))
    pixels = np.concatenate([slopes, np.full((64, 64, 1), 0.95)], axis=2).astype(np.float32)
    write_png(tmp_path / "bumps.png", pixels)
    texture = {"type": "bitmap", "filename": str(tmp_path / "bumps.png"), "raw": True}
    plain = {"type": "principled", "base_color": linear(0.6, 0.4, 0.3), "roughness": 0.4}
    material = MetallicRoughness(
        color_srgb=(0.6, 0.4, 0.3), normal_texture="bumps.png", roughness=0.4, diffuse="burley"
    )
    box = StageMesh(
        shape="cube", scale=0.7, position=(0, -0.7, 0), rotation_degrees=(0, 35, 0), material=material
    )
    # Without what softens the edges of its shadows, which the texture makes.
    bsdf = {"type": "normalmap", "normalmap": texture, "bsdf": plain, "use_shadowing_function": False}
    print("bumps", same(stage_of(FLOOR, box), tmp_path, [GROUND, bsdf, lamp()], {}))  # noqa: T201
