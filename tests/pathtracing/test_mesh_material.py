"""Meshes as files bring them: materials, textures, normals and colors of GLB, OBJ and PLY."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.core.errors import OctasplatError
from octasplat.engine.files import glb_container
from octasplat.engine.pathtracing.compile_meshes import compile_meshes
from octasplat.engine.pathtracing.kernels.texture import eval_texture
from octasplat.engine.pathtracing.mesh_files import MeshShape
from octasplat.engine.pathtracing.mesh_shapes import primitive_shape
from octasplat.engine.pathtracing.stage.materials import Diffuse, Glass, Material, MetallicRoughness
from octasplat.engine.pathtracing.stage.model import (
    Integrator,
    PointLight,
    Stage,
    StageMesh,
)
from octasplat.engine.render.image_files import write_png
from tests.support.light_scenes import camera, film_of

Y_UP = (0.0, 1.0, 0.0)
LIGHTS = (PointLight(position=(3, 2, 4), intensity=40), PointLight(position=(-3, -1, 2), intensity=10))
VIEW = camera((1.5, 1.0, 4.0), (0, 0, 0), (32, 24), 40)


def write_glb(
    path: Path,
    shape: MeshShape,
    materials: list[dict[str, Any]],
    images: list[bytes] | None = None,
    of_faces: list[int] | None = None,
    node: dict[str, Any] | None = None,
    more: dict[str, Any] | None = None,
    colors: np.ndarray | None = None,
    normals: np.ndarray | None = None,
) -> None:
    """A GLB of a shape: a primitive for each material, and images 0, 1, ... as textures of these numbers.

    ``colors`` are linear, of the vertices, with or without alpha; ``normals`` are likewise of the vertices.
    """
    document: dict[str, Any] = {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0, **(node or {})}],
        "materials": materials, "bufferViews": [], "accessors": [],
        "textures": [{"source": k} for k in range(len(images or []))], "images": [],
    }  # fmt: skip
    data = b""

    def view(content: bytes) -> int:
        nonlocal data
        document["bufferViews"].append({"buffer": 0, "byteOffset": len(data), "byteLength": len(content)})
        data += content.ljust(glb_container.pad_to_four(len(content)), b"\0")
        return len(document["bufferViews"]) - 1

    def accessor(values: np.ndarray) -> int:
        kind = glb_container.vector_type(values.shape[1])
        number = view(values.astype("<f4").tobytes())
        document["accessors"].append(
            glb_container.accessor_json(number, glb_container.FLOAT, len(values), kind)
        )
        return len(document["accessors"]) - 1

    for image in images or []:
        document["images"].append({"mimeType": "image/png", "bufferView": view(image)})
    numbers = np.array(of_faces if of_faces is not None else [0] * len(shape.faces))
    primitives = []
    for number in range(len(materials)):
        faces = shape.faces[numbers == number]
        attributes = {"POSITION": accessor(shape.vertices[faces].reshape(-1, 3))}
        if shape.corner_uv is not None:
            attributes["TEXCOORD_0"] = accessor(shape.corner_uv[numbers == number].reshape(-1, 2))
        if colors is not None:
            attributes["COLOR_0"] = accessor(colors[faces].reshape(-1, colors.shape[1]))
        if normals is not None:
            attributes["NORMAL"] = accessor(normals[faces].reshape(-1, 3))
        primitives.append({"attributes": attributes, "material": number})
    document["meshes"] = [{"primitives": primitives}]
    document["buffers"] = [{"byteLength": len(data)}]
    document |= more or {}
    text = json.dumps(document).encode()
    glb_container.write_glb(path, glb_container.pad_to_four(len(text)), len(data), [data], lambda: text)


def write_obj(path: Path, shape: MeshShape, head: str = "") -> None:
    """An OBJ with texture coordinates of its own for every corner: each vertex has several."""
    assert shape.corner_uv is not None
    lines = [head, *("v {} {} {}".format(*v) for v in shape.vertices.tolist())]
    lines += [f"vt {u} {1 - v}" for u, v in shape.corner_uv.reshape(-1, 2).tolist()]
    for k, face in enumerate((shape.faces + 1).tolist()):
        lines.append("f " + " ".join(f"{vertex}/{3 * k + c + 1}" for c, vertex in enumerate(face)))
    path.write_text("\n".join(lines) + "\n")


def welded(shape: MeshShape) -> MeshShape:
    """The same with vertices shared, as an OBJ has them."""
    vertices, owner = np.unique(shape.vertices.round(9), axis=0, return_inverse=True)
    return MeshShape(vertices, owner.reshape(-1)[shape.faces], shape.corner_uv)


def checks(path: Path, seed: int, low: float = 0.0) -> bytes:
    values = np.kron(np.random.default_rng(seed).uniform(low, 1, (4, 4, 3)), np.ones((4, 4, 1)))
    write_png(path, values.astype(np.float32))
    return path.read_bytes()


def picture(folder: Path, *meshes: StageMesh, said: Callable[[str], None] = lambda text: None) -> np.ndarray:
    numbers = Integrator(samples=4, max_depth=4, roulette_depth=9)
    stage = Stage(up=Y_UP, gaussians=(), meshes=meshes, lights=LIGHTS, integrator=numbers)
    compile_meshes(stage, folder, threads=2, warn=said)
    return film_of(stage, VIEW, folder, background=0.3).image().rgb_linear


def same_as(folder: Path, file: str, material: Material, twin: str = "twin.obj") -> np.ndarray:
    found = picture(folder, StageMesh(file=file, up_axis="y"))
    wanted = picture(folder, StageMesh(file=twin, up_axis="y", material=material))
    assert np.ptp(wanted) > 0.05
    np.testing.assert_allclose(found, wanted, atol=2e-3)
    return found


def test_ball_texture_goes_round_it_without_a_twist_at_the_poles() -> None:
    ball = primitive_shape("sphere")
    assert ball.corner_uv is not None
    x, y, z = ball.vertices[ball.faces].mean(axis=1).T
    u, v = ball.corner_uv.mean(axis=1).T
    off = (u - (0.5 + np.arctan2(x, z) / (2 * np.pi)) + 0.5) % 1 - 0.5
    assert np.abs(off).max() < 0.01 and np.abs(v - np.arctan2(np.hypot(x, z), y) / np.pi).max() < 0.01


def test_glb_material_and_textures_are_read(tmp_path: Path) -> None:
    cube = primitive_shape("cube")
    names = ("texture", "metallic_roughness_texture", "normal_texture", "emission_texture")
    images = [checks(tmp_path / f"{name}.png", k, 0.3) for k, name in enumerate(names)]
    write_obj(tmp_path / "twin.obj", welded(cube))
    material: dict[str, Any] = {
        "pbrMetallicRoughness": {
            "baseColorFactor": [0.8, 0.6, 0.5, 1], "metallicFactor": 0.7, "roughnessFactor": 0.9,
            "baseColorTexture": {"index": 0}, "metallicRoughnessTexture": {"index": 1},
        },
        "normalTexture": {"index": 2, "scale": 0.5},
        "emissiveFactor": [0.2, 0.1, 0.05],
        "emissiveTexture": {"index": 3},
        "extensions": {
            "KHR_materials_emissive_strength": {"emissiveStrength": 3.0},
            "KHR_materials_clearcoat": {"clearcoatFactor": 0.8, "clearcoatRoughnessFactor": 0.3},
        },
    }  # fmt: skip
    write_glb(tmp_path / "a.glb", cube, [material], images)
    red, green, blue = linear_to_srgb(np.array([0.8, 0.6, 0.5])).tolist()
    light = linear_to_srgb(np.array([1, 0.5, 0.25])).tolist()
    twin = MetallicRoughness(
        color_srgb=(red, green, blue), metallic=0.7, roughness=0.9, normal_scale=0.5, emission=0.6,
        emission_srgb=(1, light[1], light[2]), clear_coat=0.8, clear_coat_roughness=0.3,
        **{name: f"{name}.png" for name in names},
    )  # fmt: skip
    found = same_as(tmp_path, "a.glb", twin)
    flat = picture(
        tmp_path,
        StageMesh(file="twin.obj", up_axis="y", material=twin.model_copy(update={"normal_texture": None})),
    )
    assert np.abs(found - flat).max() > 0.02


def test_glb_textured_clear_coat_is_that_of_two_halves(tmp_path: Path) -> None:
    cube = primitive_shape("cube")
    halves = [0] * 6 + [1] * 6
    assert cube.corner_uv is not None
    # the faces of each half lie in a half of the images, away from its borders
    place = np.array([0.1, 0.6])[halves][:, None, None]
    cube = replace(cube, corner_uv=(cube.corner_uv * 0.3 + place).astype(np.float32))
    values = np.array([[51, 204, 9], [255, 102, 9]], np.float32) / 255  # red: share, green: roughness
    write_png(tmp_path / "coat.png", np.tile(np.repeat(values, 8, axis=0), (16, 1, 1)))
    image = (tmp_path / "coat.png").read_bytes()
    shading = {"baseColorFactor": [0.3, 0.05, 0.05, 1], "metallicFactor": 0, "roughnessFactor": 0.8}

    def coated(share: float, roughness: float, **textures: Any) -> dict[str, Any]:
        coat = {"clearcoatFactor": share, "clearcoatRoughnessFactor": roughness, **textures}
        return {"pbrMetallicRoughness": shading, "extensions": {"KHR_materials_clearcoat": coat}}

    named = {"clearcoatTexture": {"index": 0}, "clearcoatRoughnessTexture": {"index": 0}}
    write_glb(tmp_path / "textured.glb", cube, [coated(0.9, 0.7, **named)], [image])
    constant = [coated(0.9 * float(red), 0.7 * float(green)) for red, green, _ in values]
    write_glb(tmp_path / "split.glb", cube, constant, of_faces=halves)
    write_glb(tmp_path / "plain.glb", cube, [coated(0.9, 0.7)])
    said: list[str] = []
    found = picture(tmp_path, StageMesh(file="textured.glb"), said=said.append)
    assert said == []
    split, plain = (picture(tmp_path, StageMesh(file=name)) for name in ("split.glb", "plain.glb"))
    np.testing.assert_allclose(found, split, atol=1e-5)
    assert np.abs(found - plain).max() > 0.02
    # the same by a stage's own material
    stated = MetallicRoughness(
        color_srgb=tuple(linear_to_srgb(np.array([0.3, 0.05, 0.05])).tolist()), roughness=0.8, clear_coat=0.9,
        clear_coat_texture="coat.png", clear_coat_roughness=0.7, clear_coat_roughness_texture="coat.png",
    )  # fmt: skip
    np.testing.assert_allclose(
        picture(tmp_path, StageMesh(file="plain.glb", material=stated)), split, atol=1e-5
    )


def test_glb_materials_in_mirrored_node(tmp_path: Path) -> None:
    cube = primitive_shape("cube")
    halves = [0] * 6 + [1] * 6
    glass = {"extensions": {"KHR_materials_transmission": {"transmissionFactor": 1},
                            "KHR_materials_ior": {"ior": 1.3}},
             "pbrMetallicRoughness": {"roughnessFactor": 0}}  # fmt: skip
    matt = {"pbrMetallicRoughness": {"baseColorFactor": [0.5, 0.1, 0.1, 1], "metallicFactor": 0}}
    said: list[str] = []
    write_glb(tmp_path / "two.glb", cube, [matt, glass], of_faces=halves)
    picture(tmp_path, StageMesh(file="two.glb"), said=said.append)
    assert len(said) == 1 and "glass that is not closed" in said[0]
    # A mirrored node turns triangles inside out, which would turn glass into its opposite.
    node = {"scale": [-0.5, 0.7, 0.6], "rotation": [0, 0.6, 0, 0.8], "translation": [0.2, 0, 0]}
    write_glb(tmp_path / "ice.glb", cube, [glass], node=node)
    turn = np.array([[0.28, 0, 0.96], [0, 1, 0], [-0.96, 0, 0.28]])
    points = cube.vertices * [0.5, 0.7, 0.6] @ turn.T + [0.2, 0, 0]
    write_obj(tmp_path / "twin.obj", welded(MeshShape(points, cube.faces, cube.corner_uv)))
    same_as(tmp_path, "ice.glb", Glass(ior=1.3))


def test_obj_materials_are_read_from_mtl(tmp_path: Path) -> None:
    cube = welded(primitive_shape("cube"))
    checks(tmp_path / "wood bark.png", 1)
    checks(tmp_path / "bumps.png", 2, 0.3)
    (tmp_path / "things.mtl").write_text(
        "newmtl wood\nKd 0.5 0.5 0.5\nmap_Kd -s 1 1 1 C:\\art\\wood bark.png\nPr 0.4\nPm 0.0\n"
        "norm -bm 0.3 -o 0 0.5 -clamp on -texres 64 bumps.png\n"
        "Pc 0.5\nPcr 0.2\n"
        "newmtl lamp\nKd 0 0 0\nKe 2 2 2\n"
    )
    write_obj(tmp_path / "twin.obj", cube)
    write_obj(tmp_path / "a.obj", cube, "mtllib things.mtl\nusemtl wood")
    wood = MetallicRoughness(
        texture="wood bark.png", roughness=0.4, clear_coat=0.5, clear_coat_roughness=0.2,
        normal_texture="bumps.png", normal_scale=0.3,
    )  # fmt: skip
    same_as(tmp_path, "a.obj", wood)
    said: list[str] = []
    compile_meshes(Stage(meshes=(StageMesh(file="a.obj"),)), tmp_path, warn=said.append)
    assert len(said) == 1 and "is not used: -o of norm, -clamp of norm, a clear coat" in said[0]
    text = (tmp_path / "a.obj").read_text().splitlines()
    text.insert(-6, "usemtl lamp")
    (tmp_path / "b.obj").write_text("\n".join(text) + "\n")
    staged = compile_meshes(Stage(meshes=(StageMesh(file="b.obj"),)), tmp_path)
    assert (np.bincount(staged.surfaces.material_ids) == 6).all() and staged.lights.areas[0] == pytest.approx(
        12
    )


@pytest.mark.parametrize(
    ("library", "why"),
    [
        ("lost.mtl", "lost.mtl is not in the folder of the OBJ"),
        ("../things.mtl", "../things.mtl is not in the folder of the OBJ"),
        ("things.mtl", "no MTL file has one"),
    ],
)
def test_obj_material_without_entry_is_a_told_grey(tmp_path: Path, library: str, why: str) -> None:
    for folder in (tmp_path, tmp_path / "inner"):
        folder.mkdir(exist_ok=True)
        (folder / "things.mtl").write_text("newmtl plain\n")
    write_obj(tmp_path / "inner" / "a.obj", primitive_shape("plane"), f"mtllib {library}\nusemtl wood")
    said: list[str] = []
    found = compile_meshes(Stage(meshes=(StageMesh(file="inner/a.obj"),)), tmp_path, warn=said.append)
    assert said == [f"inner/a.obj: of the material wood is not used: its entry, as {why}."]
    # As an entry without a color.
    np.testing.assert_allclose(found.materials.colors_linear, 0.6, atol=1e-6)


def test_ply_vertex_colors_become_material(tmp_path: Path) -> None:
    plane = primitive_shape("plane")
    rows = "\n".join("{} {} {} 188 64 0".format(*vertex) for vertex in plane.vertices)
    faces = "\n".join("3 {} {} {}".format(*face) for face in plane.faces)
    head = "".join(f"property float {n}\n" for n in "xyz") + "".join(
        f"property uchar {n}\n" for n in ("red", "green", "blue")
    )
    (tmp_path / "p.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex 4\n{head}element face 2\n"
        f"property list uchar int vertex_indices\nend_header\n{rows}\n{faces}\n"
    )
    write_obj(tmp_path / "twin.obj", plane)
    same_as(tmp_path, "p.ply", Diffuse(color_srgb=(188 / 255, 64 / 255, 0)))


@pytest.mark.parametrize(
    ("material", "more", "words"),
    [
        ({}, {"extensionsUsed": ["KHR_draco_mesh_compression"]}, "compressed .KHR_draco_mesh_compression."),
        ({"baseColorTexture": {"index": 0}}, {"images": [{"uri": "wood.png"}]}, "wood.png lies outside"),
        (
            {"baseColorTexture": {"index": 0}},
            {"textures": [{"extensions": {"KHR_texture_basisu": {"source": 0}}}]},
            "KHR_texture_basisu.*export it with PNG or JPEG",
        ),
        ({"baseColorTexture": {"index": 7}}, {}, "damaged or not understood"),
        ({"roughnessFactor": -3}, {}, "negative or not finite"),
    ],
)
def test_glb_missing_data_is_named(
    tmp_path: Path, material: dict[str, Any], more: dict[str, Any], words: str
) -> None:
    given = [{"pbrMetallicRoughness": material}]
    write_glb(tmp_path / "bad.glb", primitive_shape("plane"), given, [b"no image"], more=more)
    with pytest.raises(OctasplatError, match=words) as caught:
        compile_meshes(Stage(meshes=(StageMesh(file="bad.glb"),)), tmp_path)
    assert "bad.glb" in str(caught.value) and "\n" not in str(caught.value)


@numba.njit
def texture_values(materials, places, out):  # type: ignore[no-untyped-def]
    for n in range(len(places)):
        out[n, 0], out[n, 1], out[n, 2] = eval_texture(materials, 0, places[n, 0], places[n, 1])


@pytest.mark.parametrize("across", [10497, 33071, 33648])
@pytest.mark.parametrize("down", [10497, 33071, 33648])
@pytest.mark.parametrize("is_blocky", [False, True])
def test_images_of_a_glb_go_on_beyond_their_edges_as_its_samplers_say(
    tmp_path: Path, across: int, down: int, is_blocky: bool
) -> None:
    width, height, around = 4, 3, 12
    image = np.random.default_rng(0).integers(0, 256, (height, width, 3)).astype(np.float32) / 255
    write_png(tmp_path / "a.png", image)
    sampler = {"wrapS": across, "wrapT": down, "magFilter": 9728 if is_blocky else 9729}
    # numbers, which are taken as they are
    material = {"pbrMetallicRoughness": {"metallicRoughnessTexture": {"index": 0}}}
    write_glb(
        tmp_path / "a.glb",
        primitive_shape("plane"),
        [material],
        [(tmp_path / "a.png").read_bytes()],
        more={"textures": [{"source": 0, "sampler": 0}], "samplers": [sampler]},
    )
    said: list[str] = []
    materials = compile_meshes(
        Stage(meshes=(StageMesh(file="a.glb"),)), tmp_path, warn=said.append
    ).scene.materials
    assert not said
    modes: dict[int, Any] = {10497: "wrap", 33071: "edge", 33648: "symmetric"}
    wide = np.pad(image, ((around, around), (0, 0), (0, 0)), mode=modes[down])
    wide = np.pad(wide, ((0, 0), (around, around), (0, 0)), mode=modes[across])
    places, found = np.random.default_rng(1).uniform(-2, 3, (40, 2)), np.empty((40, 3))
    texture_values(materials, places, found)
    for (u, v), value in zip(places, found, strict=True):
        x, y = u * width + around, v * height + around
        if is_blocky:
            wanted = wide[int(y), int(x)]
        else:
            i, j = int(x - 0.5), int(y - 0.5)
            s, t = x - 0.5 - i, y - 0.5 - j
            wanted = np.einsum("jik,j,i->k", wide[j : j + 2, i : i + 2], [1 - t, t], [1 - s, s])
        np.testing.assert_allclose(value, wanted, atol=1e-5)


def test_missing_textures_are_named(tmp_path: Path) -> None:
    textured = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    write_glb(tmp_path / "a.glb", primitive_shape("plane"), [textured], [b"no image"])
    with pytest.raises(OctasplatError, match=r"a\.glb \(image 0\) cannot be read as an image"):
        compile_meshes(Stage(meshes=(StageMesh(file="a.glb"),)), tmp_path)
    (tmp_path / "deep").mkdir()
    checks(tmp_path / "secret.png", 0)
    (tmp_path / "deep" / "a.mtl").write_text("newmtl m\nmap_Kd ../secret.png\n")
    write_obj(tmp_path / "deep" / "a.obj", primitive_shape("plane"), "mtllib a.mtl\nusemtl m")
    with pytest.raises(OctasplatError, match=r"names the image \.\./secret\.png, which is not in its folder"):
        compile_meshes(Stage(meshes=(StageMesh(file="deep/a.obj"),)), tmp_path)


def test_unsupported_material_feature_warns(tmp_path: Path) -> None:
    material = {
        "name": "cloth", "alphaMode": "DITHER",
        "extensions": {"KHR_materials_sheen": {}, "KHR_materials_unlit": {}},
    }  # fmt: skip
    write_glb(tmp_path / "a.glb", primitive_shape("plane"), [material])
    said: list[str] = []
    compile_meshes(Stage(meshes=(StageMesh(file="a.glb"),)), tmp_path, warn=said.append)
    assert said == ["a.glb: of the material cloth is not used: KHR_materials_sheen, alphaMode DITHER."]


@pytest.mark.parametrize(
    ("material", "reach", "told"),
    [
        (
            {"emissiveFactor": [1, 0, 0], "pbrMetallicRoughness": {"metallicRoughnessTexture": {"index": 0}}},
            1,
            "texture of metallic and roughness on glass, light of its own of glass",
        ),
        ({"pbrMetallicRoughness": {"metallicFactor": 0.25}}, 1, "metallic 0.25 of glass"),
        ({"pbrMetallicRoughness": {"metallicFactor": 0.0}}, 1, None),
        (
            {"extensions": {"KHR_materials_ior": {"ior": 5}}},
            1,
            "an index of refraction of 5 (4 is taken)",
        ),
        (
            {"normalTexture": {"index": 0, "scale": -1}, "extensions": {}},
            1,
            "the sign of the scale of its normal texture",
        ),
        ({"normalTexture": {"index": 0}, "extensions": {}}, 1, None),
        ({"normalTexture": {"index": 0}, "extensions": {}}, 2, None),
    ],
    ids=["glowing-glass", "metal", "plain-glass", "dense", "sunken", "within-image", "beyond-image"],
)
def test_what_a_glb_says_in_vain_is_told(
    tmp_path: Path, material: dict[str, Any], reach: int, told: str | None
) -> None:
    glass = {"KHR_materials_transmission": {"transmissionFactor": 1.0}}
    cube = primitive_shape("cube")
    assert cube.corner_uv is not None
    more = {"textures": [{"source": 0, "sampler": 0}], "samplers": [{"wrapS": 33648}]}
    write_glb(
        tmp_path / "a.glb",
        replace(cube, corner_uv=reach * cube.corner_uv),
        [{"name": "m", "extensions": glass} | material],
        [checks(tmp_path / "a.png", 0)],
        more=more,
    )
    said: list[str] = []
    compile_meshes(Stage(meshes=(StageMesh(file="a.glb"),)), tmp_path, warn=said.append)
    assert said == ([] if told is None else [f"a.glb: of the material m is not used: {told}."])
