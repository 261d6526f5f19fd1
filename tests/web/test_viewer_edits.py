"""What the viewer shows of crop and clean is what they do; what is picked, and what links keep."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import octasplat.service.web as service_web
from octasplat.engine.dataset.camera import Camera
from octasplat.engine.dataset.camera_clearance import CameraClearance
from octasplat.engine.dataset.model import PosedView, Viewpoints
from octasplat.engine.dataset.view_frusta import ViewFrusta
from octasplat.engine.edit.cleaning import clean
from octasplat.engine.edit.edit_options import CleanupOptions, Selection
from octasplat.engine.edit.selection import selection_mask
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.pinhole_camera import focal_from_fov
from tests.support.browser import open_page

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

STATIC = Path(service_web.__file__).parent / "static"
PAGE = """<!doctype html>
<html><body><script type="module">
import { PerspectiveCamera, Vector3 } from "/files/vendor/three.js";
import { removedBy } from "/files/viewer/cleaning.js";
import { readHdr } from "/files/viewer/environment.js";
import { toHalf } from "/files/viewer/half.js";
import { makeTree } from "/files/viewer/nearest.js";
import { pick } from "/files/viewer/picking.js";
import { readGaussians } from "/files/viewer/ply.js";
import { linkOf, viewOf } from "/files/viewer/view_link.js";
const job = JOB;
window.result = (async () => { BODY })();
</script></body></html>
"""
SIDE_PX, FOV_DEGREES = 200, 40.0


def in_page(body: str, scene: Path | None = None, **job: Any) -> Any:
    files = {path.relative_to(STATIC).as_posix(): path for path in STATIC.rglob("*.js")}
    if scene is not None:
        files["scene.ply"] = scene
    page = open_page(PAGE.replace("JOB", json.dumps(job)).replace("BODY", body), files=files)
    assert page.result is not None, page.messages
    return page.result


READ = 'const scene = readGaussians(new Uint8Array(await (await fetch("/files/scene.ply")).arrayBuffer()));'


@pytest.fixture(scope="module")
def cluttered() -> FlatGaussians:
    """A ball of Gaussians, with faint, huge, far and lonely ones among them."""
    rng = np.random.default_rng(5)
    count = 3000
    means = rng.normal(size=(count, 3)) * 0.5
    means[:60] = rng.uniform(-6, 6, size=(60, 3))
    means[60:75] = (1.9, 0.1, 0.2) + rng.normal(size=(15, 3)) * 0.01
    return FlatGaussians(
        means_world=means.astype(np.float32),
        quats_wxyz=rng.normal(size=(count, 4)).astype(np.float32),
        log_scales=rng.uniform(np.log(0.02), np.log(0.09), size=(count, 2)).astype(np.float32),
        opacity_logits=rng.normal(size=count).astype(np.float32) * 3,
        sh=rng.normal(size=(count, 1, 3)).astype(np.float32),
    )


def viewpoints() -> Viewpoints:
    """Views around the origin, three of which look elsewhere."""
    focal = focal_from_fov(FOV_DEGREES, SIDE_PX)
    camera = Camera("PINHOLE", (focal, focal, SIDE_PX / 2, SIDE_PX / 2), SIDE_PX, SIDE_PX)
    views = []
    for k in range(9):
        angle = 2 * np.pi * k / 9
        forward = np.array([np.sin(angle), 0.0, np.cos(angle)]) * (1 if k % 3 else -1)
        rotation = np.stack([np.cross([0.0, 1.0, 0.0], forward), [0.0, 1.0, 0.0], forward])
        centre = -3.0 * np.array([np.sin(angle), 0.0, np.cos(angle)])
        views.append(PosedView(f"{k}.png", 0, rotation, -rotation @ centre, SIDE_PX, SIDE_PX))
    return Viewpoints(tuple(views), (camera,))


def shown_views(scene: Viewpoints, nearest: float) -> list[dict[str, Any]]:
    return [
        {
            "position": view.origin_world.tolist(),
            "forward": view.rotation_cam_from_world[2].tolist(),
            "up": (-view.rotation_cam_from_world[1]).tolist(),
            "fov_y_degrees": FOV_DEGREES,
            "aspect": 1.0,
            "held_out": k == 8,
            "nearest_world": nearest,
        }
        for k, view in enumerate(scene.views)
    ]


@pytest.mark.parametrize("limits", [{}, {"max_scale": 0.08, "min_opacity": 0.2}, {"min_views": 4}])
def test_clean_is_shown_as_it_does(cluttered: FlatGaussians, limits: dict[str, Any], tmp_path: Path) -> None:
    scene, trained = viewpoints(), np.arange(8)
    min_views = limits.get("min_views", 0)
    options = CleanupOptions(**{name: value for name, value in limits.items() if name != "min_views"})
    zones = CameraClearance.from_views(scene, np.full(9, 0.25 * 6.0), trained)
    frusta = ViewFrusta.from_views(scene, trained)
    seen = (lambda xyz: frusta.contains_often(xyz, min_views)) if min_views else None
    keep, report = clean(cluttered, options, zones, seen)
    assert report.near > 0 and report.floating > 15 and (report.unseen > 0) == bool(min_views)
    write_gaussian_ply(cluttered, tmp_path / "scene.ply")
    found = in_page(
        READ
        + "const { removed, counts, kept } = removedBy(scene, job.views, { box: null, clean: job.clean });"
        "return { removed: [...removed.keys()].filter((i) => removed[i]), counts, kept };",
        tmp_path / "scene.ply",
        views=shown_views(scene, 6.0),
        clean={**options.model_dump(), "camera_clearance": 0.25, "min_views": min_views},
    )
    assert found["removed"] == np.flatnonzero(~keep).tolist()
    assert found["kept"] == report.kept
    expected = {"faint": report.faint, "large": report.large, "near": report.near, "unseen": report.unseen}
    assert found["counts"] == {"outside": 0, **expected, "floating": report.floating}


def test_crop_is_shown_as_it_does(cluttered: FlatGaussians, tmp_path: Path) -> None:
    box = (-0.5, -0.25, -1.0, 0.5, 0.75, 0.25)
    keep = selection_mask(cluttered, Selection(box=box), (0.0, 0.0, 0.0))
    write_gaussian_ply(cluttered, tmp_path / "scene.ply")
    found = in_page(
        READ + "const { removed, counts, kept } = removedBy(scene, [], { box: job.box, clean: null });"
        "return { removed: [...removed.keys()].filter((i) => removed[i]), outside: counts.outside, kept };",
        tmp_path / "scene.ply",
        box=box,
    )
    assert found["removed"] == np.flatnonzero(~keep).tolist()
    assert (found["outside"], found["kept"]) == ((~keep).sum(), keep.sum())


def test_points_are_picked_where_half_of_the_light_is_stopped(tmp_path: Path) -> None:
    """A veil at z = 1 that lets most through, a wall at z = 2 of width 1, and nothing beside it."""
    wall = FlatGaussians(
        means_world=np.float32([[0, 0, 1], [0.1, 0, 2]]),
        quats_wxyz=np.float32([[1, 0, 1, 0], [1, 0, 1, 0]]),  # the normal is along z
        log_scales=np.log(np.float32([[0.5, 0.5], [0.5, 0.5]])),
        opacity_logits=np.float32([-1.0, 4.0]),
        sh=np.zeros((2, 1, 3), np.float32),
    )
    write_gaussian_ply(wall, tmp_path / "scene.ply")
    found = in_page(
        READ + "return ['ahead', 'aside', 'beyond'].map((name) => pick(scene, [0, 0, 0], job[name], 9.21))"
        ".concat([pick(scene, [0, 0, 0], job.ahead, 9.21, Uint8Array.of(0, 1))]);",
        tmp_path / "scene.ply",
        ahead=[0, 0, 1],
        aside=[0.1, 0.05, 1],
        beyond=[2, 0, 1],
    )
    np.testing.assert_allclose(found[0], [0, 0, 2], atol=1e-6)
    np.testing.assert_allclose(found[1], [0.2, 0.1, 2], atol=1e-6)
    assert found[2] is None
    np.testing.assert_allclose(found[3], [0, 0, 1], atol=1e-6)  # the veil alone stops most of what is stopped


def test_what_is_too_faint_to_be_drawn_is_not_picked(tmp_path: Path) -> None:
    """Two hundred Gaussians too faint for an octagon, before a wall."""
    count = 201
    means = np.zeros((count, 3), np.float32)
    means[:, 2] = np.linspace(1, 3, count)
    opacities = np.full(count, 0.009)
    opacities[-1] = 0.99
    scene = FlatGaussians(
        means_world=means,
        quats_wxyz=np.tile(np.float32([1, 0, 1, 0]), (count, 1)),
        log_scales=np.full((count, 2), np.log(0.5), np.float32),
        opacity_logits=np.log(opacities / (1 - opacities)).astype(np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
    )
    write_gaussian_ply(scene, tmp_path / "scene.ply")
    found = in_page(READ + "return pick(scene, [0, 0, 0], [0, 0, 1], 9.21);", tmp_path / "scene.ply")
    np.testing.assert_allclose(found, [0, 0, 3], atol=1e-6)


def test_what_is_not_drawn_is_not_picked(tmp_path: Path) -> None:
    """A streak that no photograph shows, before a wall that they show, is passed by as in the picture."""
    scene = FlatGaussians(
        means_world=np.float32([[0, -5, 0], *([0.01 * k, 0, 0] for k in range(4))]),
        quats_wxyz=np.tile(np.float32([1, 0, 0, 1]), (5, 1)),  # the normal is along y
        log_scales=np.full((5, 2), np.log(0.5), np.float32),
        opacity_logits=np.full(5, 6.0, np.float32),
        sh=np.zeros((5, 1, 3), np.float32),
    )
    write_gaussian_ply(scene, tmp_path / "scene.ply")
    found = in_page(
        """
        const worker = new Worker("/files/viewer/scene_worker.js", { type: "module" });
        const answer = (message, name) => new Promise((resolve) => {
            worker.addEventListener("message", ({ data }) => { if (name in data) resolve(data[name]); });
            worker.postMessage(message);
        });
        await answer({ load: new URL("/files/scene.ply", location.href).href, views: job.views }, "scene");
        return await answer({ pick: { origin: [0, -8, 0], direction: [0, 1, 0], q: 9.21 }, id: 1 }, "picked");
        """,
        tmp_path / "scene.ply",
        views=shown_views(viewpoints(), 6.0),
    )
    np.testing.assert_allclose(found, [0, 0, 0], atol=1e-6)


def test_links_keep_a_view_and_nothing_else_is_taken_for_one() -> None:
    found = in_page(
        "const link = linkOf([1.25, -2, 1e-7], [0, 3.5, -40000], 51.5, 0.75);"
        "const older = viewOf('#view=1,2,3,4,5,6,50');"
        "return { link, view: viewOf(link), older, others: job.others.map(viewOf) };",
        others=[
            "",
            "#h-view",
            "#view=1,2,3",
            "#view=1,2,3,4,5,6,x",
            "#view=1,2,3,4,5,6,1e999",
            "#view=1,2,3,4,5,6,7,8,9",
        ],
    )
    expected = {"position": [1.25, -2, 1e-7], "target": [0, 3.5, -40000], "fovY": 51.5, "aspect": 0.75}
    assert found["view"] == expected
    assert found["older"] == {"position": [1, 2, 3], "target": [4, 5, 6], "fovY": 50}
    assert found["others"] == [None] * 6


def test_nearest_neighbors_are_those_of_a_full_search() -> None:
    points = np.random.default_rng(2).normal(size=(400, 3))
    points[50:80] = points[50]  # many at one place
    found = in_page(
        "const tree = makeTree(Float64Array.from(job.points));"
        "return Array.from({ length: 400 }, (_, k) => [...tree.nearest(k, 7).distances]);",
        points=points.ravel().tolist(),
    )
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(distances, np.inf)
    np.testing.assert_allclose(found, np.sort(distances, axis=1)[:, :7], atol=1e-12)


def test_half_precision_numbers_are_the_nearest() -> None:
    values = [0.0, 6e-8, 3e-5, 0.1, -1.7, 1000.3, 32767.0, 32768.0, 40000.0, -50010.0, 65504.0, 65519.0]
    beyond = [65520.0, 1e6, float("inf")]
    found = in_page(
        "return [...job.values, ...job.beyond.map(Number)].map(toHalf);",
        values=values,
        beyond=[str(value).replace("inf", "Infinity") for value in beyond],
    )
    shown = np.uint16(found).view(np.float16)
    np.testing.assert_array_equal(shown, np.float16([*values, *[65504.0] * len(beyond)]))


@pytest.mark.parametrize("kind", ["rgbe", "xyze"])
def test_maps_in_other_colors_are_refused(kind: str) -> None:
    header = f"#?RADIANCE\n# FORMAT=none\nFORMAT=32-bit_rle_{kind}\n\n-Y 1 +X 2\n"
    found = in_page(
        "const read = () => [...readHdr(new TextEncoder().encode(job.text).buffer).data];"
        "try { return read(); } catch ({ message }) { return message; }",
        text=header + "@@@\x7f" * 2,
    )
    refused = "The 3D view takes light from Radiance HDR files only."
    assert found == ([0.125] * 6 if kind == "rgbe" else refused)
