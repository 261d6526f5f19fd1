"""Materials baked into textures: they hold what the Gaussians have, and normals lie as glTF says."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.files import read_mesh, write_surface
from octasplat.engine.files.glb_container import GlbFile
from octasplat.engine.geometry.triangle_mesh import TriangleMesh
from octasplat.engine.shading.environment_frame import environment_frame
from octasplat.engine.surface.bake_materials import material_features, with_materials
from octasplat.engine.surface.extract import extract_levels
from octasplat.engine.surface.options import ExtractionOptions
from octasplat.engine.surface.tangents import vertex_tangents
from octasplat.engine.surface.texture import TextureLayout
from octasplat.engine.trace.cpu.tracer import CpuTracer
from tests.support.surface_shapes import cameras_on_sphere

SIDE = 256
UP = (0.0, 0.0, 1.0)
ABOVE = {"albedo": (0.9, 0.5, 0.1), "metallic": 1.0, "roughness": 0.2, "ambient": 0.8}
BELOW = {"albedo": (0.1, 0.2, 0.6), "metallic": 0.0, "roughness": 0.7, "ambient": 0.8}


@pytest.fixture(scope="module")
def surface(ball, tmp_path_factory) -> TriangleMesh:
    """A ball, metal above z = 0 and plastic below, as a mesh with textures."""
    above = ball.means_world[:, 2:] > 0
    scene = ball.with_channels(
        {name: np.where(above, ABOVE[name], BELOW[name]).astype(np.float32) for name in ABOVE}
    )
    tracer = CpuTracer(threads=1)
    tracer.build(scene, material_features(scene))
    options = ExtractionOptions(resolution=64, depth_side=96, texture_size=SIDE)
    (extracted,) = extract_levels(
        tracer, cameras_on_sphere(30, 3.0, 96), options, (1500,),
        scratch=tmp_path_factory.mktemp("scratch"), light_frame=environment_frame(np.array(UP)),
    )  # fmt: skip
    return extracted.mesh


def at_middles(mesh: TriangleMesh, image: np.ndarray) -> np.ndarray:
    """What an image shows in the middle of each triangle, in [0, 1]."""
    at = mesh.uv[mesh.faces].mean(axis=1) * SIDE
    return image[at[:, 1].astype(int), at[:, 0].astype(int)] / 255


def decoded(mesh: TriangleMesh, shown: np.ndarray) -> np.ndarray:
    """World normals of the triangles' middles, as glTF 2.0 (3.9.3 and 3.7.2.1) puts them together."""
    normal = mesh.vertex_normals()[mesh.faces].mean(axis=1)
    tangent = mesh.materials.tangents[mesh.faces].mean(axis=1)
    normal, along = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (normal, tangent[:, :3]))
    across = np.cross(normal, along) * np.sign(tangent[:, 3:])
    x, y, z = (2 * shown - 1).T[:, :, None]
    found = x * along + y * across + z * normal
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def test_textures_hold_the_materials(surface):
    height = surface.face_corners_world.mean(axis=1)[:, 2]
    packed = at_middles(surface, surface.materials.occlusion_roughness_metallic)
    color = at_middles(surface, surface.texture_srgb)
    for side, known in ((height > 0.3, ABOVE), (height < -0.3, BELOW)):
        wanted = [known["ambient"], known["roughness"], known["metallic"]]
        np.testing.assert_allclose(packed[side], np.tile(wanted, (side.sum(), 1)), atol=0.01)
        albedo = linear_to_srgb(np.array(known["albedo"]))
        np.testing.assert_allclose(color[side], np.tile(albedo, (side.sum(), 1)), atol=0.01)


def test_normals_are_those_of_the_ball(surface):
    """Flat where the mesh has the ball's normals, and the ball's all over."""
    shown = at_middles(surface, surface.materials.normals)
    middles = surface.face_corners_world.mean(axis=1)
    ball = middles / np.linalg.norm(middles, axis=1, keepdims=True)
    degrees = np.degrees(np.arccos(np.clip((decoded(surface, shown) * ball).sum(axis=1), -1, 1)))
    of_mesh = surface.vertex_normals()[surface.faces].mean(axis=1)
    of_mesh /= np.linalg.norm(of_mesh, axis=1, keepdims=True)
    without = np.degrees(np.arccos(np.clip((of_mesh * ball).sum(axis=1), -1, 1)))
    assert degrees.mean() < 1.5 and degrees.mean() < without.mean()
    flat = without < 1.0
    assert flat.sum() > 50
    np.testing.assert_allclose(shown[flat], np.tile([0.5, 0.5, 1.0], (flat.sum(), 1)), atol=0.05)


def turned_square(mirrored: bool) -> TriangleMesh:
    """A square that faces z; u grows along (1, 2, 0), v to its right hand, or to its left if mirrored."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    along = np.array([1, 2, 0]) / np.sqrt(5)
    down = np.cross(along, [0, 0, 1]) * (-1 if mirrored else 1)
    uv = 0.5 + 0.25 * (vertices @ np.stack([along, down], axis=1))
    return TriangleMesh(vertices, np.array([[0, 1, 2], [0, 2, 3]], np.int32), uv=uv.astype(np.float32))


@pytest.mark.parametrize("mirrored", [False, True])
def test_surface_normal_map_matches_world_normals(mirrored):
    mesh = turned_square(mirrored)
    tangents = vertex_tangents(mesh)
    np.testing.assert_allclose(tangents[:, :3], np.tile(np.array([1, 2, 0]) / np.sqrt(5), (4, 1)), atol=1e-6)
    assert (tangents[:, 3] == (-1 if mirrored else 1)).all()
    # Two pixels that show the square's middle; of the second nothing is known.
    corners, weights = np.array([[0, 1, 2]] * 2, np.int32), np.array([[0.5, 0.0, 0.5]] * 2)
    layout = TextureLayout(mesh, 2, np.array([0, 1]), np.array([0, 1]), corners, weights)
    leaning = np.array([0.48, -0.36, 0.8])
    baked = np.tile(np.float32([0, 0, 0, 0, 0, 0, *(0.7 * leaning)]), (2, 1))
    lit = with_materials(layout, baked, np.array([True, False]), np.eye(3))
    found = decoded(lit, lit.materials.normals[[0, 1], [0, 1]] / 255)
    np.testing.assert_allclose(found[0], leaning, atol=0.006)
    np.testing.assert_allclose(found[1], (0, 0, 1), atol=0.006)


def test_surface_normal_facing_away_is_projected_to_tangent():
    mesh = turned_square(False)
    layout = TextureLayout(
        mesh, 1, np.array([0]), np.array([0]), np.array([[0, 1, 2]], np.int32), np.array([[1.0, 0, 0]])
    )
    baked = np.float32([[0, 0, 0, 0, 0, 0, 0.6, 0.0, -0.8]])
    lit = with_materials(layout, baked, np.array([True]), np.eye(3))
    found = decoded(lit, np.tile(lit.materials.normals[0] / 255, (2, 1)))
    np.testing.assert_allclose(found[0], (0.995, 0, 0.1), atol=0.006)


def test_surface_glb_has_materials_and_environment(surface, tmp_path: Path):
    path = tmp_path / "lit.glb"
    assert write_surface(surface, path) == (path,)
    seen = trimesh.load(path, force="mesh", process=False)
    # The light's up, here z, is glTF's y; its forward, x, stays x.
    np.testing.assert_allclose(seen.vertices, surface.vertices_world[:, [0, 2, 1]] * [1, 1, -1], atol=1e-6)
    material = seen.visual.material
    maps = surface.materials
    for image, written in (
        (material.baseColorTexture, surface.texture_srgb),
        (material.metallicRoughnessTexture, maps.occlusion_roughness_metallic),
        (material.occlusionTexture, maps.occlusion_roughness_metallic),
        (material.normalTexture, maps.normals),
    ):
        np.testing.assert_array_equal(np.asarray(image.convert("RGB")), written)
    document = GlbFile(path).document
    assert "extensionsUsed" not in document
    assert "TANGENT" in document["meshes"][0]["primitives"][0]["attributes"]
    (again,) = read_mesh(path, with_materials=True).materials
    assert (again.metallic, again.roughness) == (1.0, 1.0)
    assert again.normal_texture is not None and again.metallic_roughness_texture is not None
    assert not again.unsupported or again.unsupported == ("occlusionTexture",)
