"""Operations on a scene of large coordinates give what they give at the origin, in the user's coordinates."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result

from octasplat.engine.core.local_origin import NO_ORIGIN, Origin
from octasplat.engine.files import read_mesh, read_metadata, read_scene
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.scene_metadata import SceneMetadata
from octasplat.engine.render.image_files import read_image

ORIGIN = (500_000.0, 5_400_000.0, 250.0)
Run = Callable[..., Result]


class Site:
    """The same scene and meshes about an origin in the user's coordinates, in a folder of their own."""

    def __init__(self, folder: Path, scene: FlatGaussians, origin: Origin) -> None:
        folder.mkdir()
        self.folder, self.origin, self.scene = folder, np.array(origin), folder / "scene.ply"
        write_gaussian_ply(scene, self.scene, facts=SceneMetadata(origin_world=origin))

    def mesh(self, name: str, vertices: np.ndarray, faces: str) -> Path:
        """Write a mesh in the user's coordinates, as a program with 64 bits does."""
        lines = [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in vertices + self.origin]
        (self.folder / name).write_text("\n".join(lines) + "\n" + faces)
        return self.folder / name

    def place(self, *offset: float) -> list[float]:
        return [float(value) for value in self.origin + offset]


@pytest.fixture
def sites(make_scene: Callable[..., FlatGaussians], tmp_path: Path) -> tuple[Site, Site]:
    scene = make_scene(120)
    half, one = np.full((120, 3), 0.5, np.float32), np.ones((120, 1), np.float32)
    scene = scene.with_channels({"albedo": half, "metallic": one, "roughness": one})
    return Site(tmp_path / "near", scene, NO_ORIGIN), Site(tmp_path / "far", scene, ORIGIN)


CUBE = np.array([[x, y, z] for x in (-1.3, 1.3) for y in (-1.3, 1.3) for z in (-1.3, 1.3)])
CUBE_FACES = "".join(
    f"f {a} {b} {c}\n"
    for a, b, c in zip(
        (1, 1, 5, 5, 1, 1, 3, 3, 1, 1, 2, 2),
        (2, 4, 7, 8, 5, 6, 4, 8, 3, 7, 6, 8),
        (4, 3, 8, 6, 6, 2, 8, 7, 7, 5, 8, 4),
        strict=True,
    )
)


def run(octasplat: Run, *arguments: object) -> str:
    result = octasplat(*arguments)
    assert result.exit_code == 0, result.output
    return " ".join(result.output.split())


def assert_same(near: Path, far: Path, tolerance: float = 2e-6) -> None:
    """Compare scenes about their local origins, and say that the far one still has its own."""
    one, other = read_scene(near)[0], read_scene(far)[0]
    for name in ("means_world", "quats_wxyz", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_allclose(getattr(other, name), getattr(one, name), atol=tolerance)
    assert one.channels.keys() == other.channels.keys()
    for name, values in one.channels.items():
        np.testing.assert_array_equal(other.channels[name], values)
    assert read_metadata(near).origin_world == NO_ORIGIN
    assert read_metadata(far).origin_world == ORIGIN


def test_deform_by_meshes_in_user_coordinates(octasplat: Run, sites: tuple[Site, Site]) -> None:
    moved = CUBE @ np.array([[1.1, 0.2, 0], [0, 0.9, 0], [0, 0.1, 1.3]]) + [0.3, 0.1, -0.2]
    for site in sites:
        proxy, bent = site.mesh("cube.obj", CUBE, CUBE_FACES), site.mesh("bent.obj", moved, CUBE_FACES)
        out = site.folder / "out.ply"
        run(octasplat, "deform", site.scene, "--proxy", proxy, "--deformed", bent, "-o", out)
    assert_same(sites[0].folder / "out.ply", sites[1].folder / "out.ply", 1e-5)
    assert not np.allclose(read_scene(out)[0].means_world, read_scene(site.scene)[0].means_world, atol=0.1)


def test_material_by_mesh_and_box_in_user_coordinates(octasplat: Run, sites: tuple[Site, Site]) -> None:
    for site in sites:
        run(octasplat, "export", site.scene, site.folder / "mesh.ply")
        mesh = site.folder / "mesh.ply"
        box = (*site.place(-0.7, -0.7, -2), *site.place(0.7, 0.7, 2))
        out = site.folder / "out.ply"
        where = ("--mesh", mesh, "--box", *box)
        run(octasplat, "material", site.scene, *where, "--set", "roughness=0.3", "-o", out)
    changed = read_scene(out)[0].channels["roughness"] < 0.4
    assert 0 < changed.sum() < len(changed)
    assert_same(sites[0].folder / "out.ply", sites[1].folder / "out.ply")


def test_edit_by_a_mesh_in_user_coordinates(octasplat: Run, sites: tuple[Site, Site]) -> None:
    for site in sites:
        run(octasplat, "export", site.scene, site.folder / "mesh.ply")
        mesh = read_mesh(site.folder / "mesh.ply").about(tuple(site.origin))
        faces = "".join(f"f {a} {b} {c}\n" for a, b, c in (mesh.triangles + 1).tolist())
        edited = site.mesh("edited.obj", mesh.vertices + np.array([0.25, 0, 0]), faces)
        run(octasplat, "edit", site.scene, "--mesh", edited, "-o", site.folder / "out.ply")
    one, other = (read_scene(site.folder / "out.ply")[0].means_world for site in sites)
    np.testing.assert_allclose(other, one, atol=1e-5)


STAGE = """
[[gaussians]]
light = "shadowed"

[[meshes]]
shape = "sphere"
position = {ball}
scale = 0.4
material = {{ kind = "diffuse" }}

[[meshes]]
file = "cube.obj"
scale = 1.0
material = {{ kind = "mirror" }}

[[lights]]
kind = "point"
position = {lamp}
intensity = 9.0

[integrator]
samples = 2
"""


def render_stage(octasplat: Run, site: Site, name: str, stage: str) -> tuple[np.ndarray, str]:
    (site.folder / "stage.toml").write_text(stage)
    camera = ("--camera", *site.place(1, -2, -4), "--look-at", *site.place(0, 0, 0), "--fov", 50)
    out = site.folder / f"{name}.png"
    told = run(
        octasplat, "render", site.scene, "--stage", site.folder / "stage.toml", *camera,
        "--width", 32, "--height", 24, "-o", out,
    )  # fmt: skip
    return read_image(out), told


def test_stage_in_user_coordinates_or_about_the_origin_is_rendered_the_same(
    octasplat: Run, sites: tuple[Site, Site]
) -> None:
    near, far = sites
    for site in sites:
        site.mesh("cube.obj", CUBE * 0.3 + [1.0, 0, 0], CUBE_FACES)
    stages = [STAGE.format(ball=site.place(0, -0.6, -0.4), lamp=site.place(0, -3, -3)) for site in sites]
    expected, told = render_stage(octasplat, near, "near", stages[0])
    assert "local origin" not in told and np.ptp(expected) > 0
    found, told = render_stage(octasplat, far, "whole", stages[1])
    np.testing.assert_allclose(found, expected, atol=2)
    assert "local origin 500000 5400000 250" in told
    assert "subtracted from meshes[0].position, lights[0].position" in told
    found, told = render_stage(octasplat, far, "local", stages[0])
    np.testing.assert_allclose(found, expected, atol=2)
    assert "subtracted" not in told and "local origin 500000 5400000 250" in told


def test_first_stage_of_a_far_scene_says_its_origin(octasplat: Run, sites: tuple[Site, Site]) -> None:
    texts = []
    for site in sites:
        run(octasplat, "stage", "init", site.scene, "-o", site.folder / "first.toml")
        texts.append((site.folder / "first.toml").read_text())
    near, far = (text.splitlines() for text in texts)
    (note,) = set(far) - set(near)
    assert note.startswith("# Places of the stage are about the scene's local origin 500000 5400000 250")
    assert [line for line in far if line != note] == near


def test_far_and_near_scenes_are_merged_with_a_warning(
    octasplat: Run, sites: tuple[Site, Site], tmp_path: Path
) -> None:
    near, far = sites
    told = run(octasplat, "merge", far.scene, near.scene, "-o", tmp_path / "out.ply")
    assert "keep its positions to 0.5 units only" in told and "transform --translate" in told
    moved = tmp_path / "moved.ply"
    run(octasplat, "transform", near.scene, "--translate", *ORIGIN, "-o", moved)
    told = run(octasplat, "merge", far.scene, moved, "-o", tmp_path / "both.ply")
    assert "units only" not in told
    positions = read_scene(tmp_path / "both.ply")[0].means_world
    np.testing.assert_allclose(positions[:120], positions[120:], atol=1e-6)


@pytest.mark.exhaustive
def test_surface_of_a_far_scene_is_that_at_the_origin(
    octasplat: Run, make_scene: Callable[..., FlatGaussians], tmp_path: Path
) -> None:
    scene = make_scene(300, size=0.2, sh_degree=0)
    ball = scene.means_world / np.linalg.norm(scene.means_world, axis=1, keepdims=True)
    quats = _turning_x_to(ball)
    scene = replace(scene, means_world=ball.astype(np.float32), quats_wxyz=quats.astype(np.float32))
    meshes = []
    for name, origin in (("near", NO_ORIGIN), ("far", ORIGIN)):
        site = Site(tmp_path / name, scene, origin)
        box = (*site.place(-1.6, -1.6, -1.6), *site.place(1.6, 1.6, 0.4))
        options = ("--resolution", 20, "--depth-side", 96, "--no-fit", "--box", *box)
        run(octasplat, "surface", site.scene, "-o", site.folder / "surface.ply", *options)
        meshes.append(read_mesh(site.folder / "surface.ply").about(tuple(site.origin)))
    assert len(meshes[0].vertices) > 50
    np.testing.assert_allclose(meshes[1].vertices, meshes[0].vertices, atol=1e-4)


def _turning_x_to(directions: np.ndarray) -> np.ndarray:
    """Return the quaternions that turn the x axis to unit vectors."""
    quats = np.column_stack(
        (1 + directions[:, 0], np.zeros(len(directions)), -directions[:, 2], directions[:, 1])
    )
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)
