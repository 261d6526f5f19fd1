"""Folders of ``benchmarks.material_things``: what maps and pictures say of a plane and a mirror ball."""

import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import material_losses
from benchmarks.material_thing_shapes import RADIUS, THINGS, Thing, ball, even, moved, thing_of
from benchmarks.material_thing_skies import SKIES, map_directions
from benchmarks.material_things import CHOOSING, REPORTING, Sizes, write_thing
from octasplat import reconstruct
from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.dataset import load_dataset_model
from octasplat.engine.dataset.synthetic.shapes import box_mesh
from octasplat.engine.evaluate.ground_truth import read_ground_truth
from octasplat.engine.render.environment_files import read_environment
from octasplat.engine.render.image_files import read_image
from octasplat.engine.render.shots import view_shots
from tests.support.small_run import RUN_OPTIONS

pytest.importorskip("mitsuba")
pytestmark = pytest.mark.heavy

RADIUS_OF_BALL = 0.5 * RADIUS / np.linalg.norm([1.0, 1.0, 0.55])  # the floor's corners are farthest off


def slope(direction: np.ndarray) -> np.ndarray:
    """A sky that is linear in the direction, so that pixels and texels show what is at their centres."""
    return 0.4 + direction @ np.array([[0.2, 0.0, 0.1], [0.0, 0.15, 0.0], [0.1, 0.0, 0.15]])


def ball_on_floor() -> Thing:
    floor = box_mesh((2.0, 2.0, 0.1), 8)
    return thing_of([(floor, even("c04020", 0.6, 0.0)), (moved(ball(0.5), z=0.6), even("ffffff", 0.03, 1.0))])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("things") / "ball"
    sky = slope(map_directions(64)).astype(np.float32)
    sizes = Sizes(
        side=48, train_views=6, test_views=4, relit_views=2, train_samples=4, test_samples=64,
        points=60, denoise=False,
    )  # fmt: skip
    write_thing(root, "ball", ball_on_floor(), {"slope": sky, "dark": 0.25 * sky}, sizes)
    return root


@pytest.mark.exhaustive
def test_maps_hold_the_materials_normals_and_depths_of_the_parts(folder: Path) -> None:
    truth = read_ground_truth(folder / "truth.json")
    model = load_dataset_model(folder / "test", min_views=1, for_training=False)
    for view, shot in zip(model.views, view_shots(model, np.arange(4)), strict=True):
        known = truth.view(view.name, (48, 48))
        assert known.normal_world is not None and known.depth_z is not None
        assert known.albedo_linear is not None and known.metallic is not None
        is_ball = known.mask & (known.metallic > 0.5)
        is_floor = known.mask & ~is_ball
        assert is_ball.sum() > 50 and is_floor.sum() > 50
        ways = shot.rays().directions_world.astype(np.float64)
        ways /= (ways @ view.rotation_cam_from_world[2])[..., None]
        points = shot.rays().origin_world + known.depth_z[..., None] * ways
        assert known.roughness is not None
        assert np.allclose(known.albedo_linear[is_ball], 1) and np.allclose(
            linear_to_srgb(known.albedo_linear[is_floor]), np.array([0xC0, 0x40, 0x20]) / 255, atol=0.003
        )
        assert np.allclose(known.roughness[is_floor], 0.6, atol=0.003)
        # the slab has sides and an underside, too
        flat = np.abs(known.normal_world[is_floor]).max(axis=1)
        assert np.allclose(flat, 1, atol=1e-3)
        is_top = is_floor & (known.normal_world[..., 2] > 0.99)
        if shot.rays().origin_world[2] > 1:
            assert is_top.sum() > 50 and np.ptp(points[is_top][:, 2]) < 1e-3
        # of a ball, points lie one radius along the normal from one centre
        moved_back = points[is_ball] - RADIUS_OF_BALL * known.normal_world[is_ball]
        assert np.ptp(moved_back, axis=0).max() < 0.01
        assert np.all((known.normal_world[is_ball] * ways[is_ball]).sum(axis=1) < 0)


def test_mirror_shows_the_environment_where_the_reflected_ray_goes(folder: Path) -> None:
    truth = read_ground_truth(folder / "truth.json")
    model = load_dataset_model(folder / "test", min_views=1, for_training=False)
    shots = view_shots(model, np.arange(4))
    compared = 0
    lights = [(folder / "test" / "images", 1.0), (folder / "relight" / "dark", 0.25)]
    for images, factor in lights:
        for view, shot in zip(model.views, shots, strict=True):
            if not (images / view.name).is_file():
                continue
            known, picture = truth.view(view.name, (48, 48)), read_image(images / view.name)
            assert known.normal_world is not None and known.metallic is not None
            ways = shot.rays().directions_world.astype(np.float64)
            ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
            facing = (known.normal_world * ways).sum(axis=-1, keepdims=True)
            mirrored = ways - 2 * facing * known.normal_world
            chosen = (known.metallic > 0.5) & (facing[..., 0] < -0.8) & (mirrored[..., 2] > 0.1)
            chosen &= picture[..., 3] == 1
            expected = linear_to_srgb(factor * slope(mirrored[chosen]))
            assert np.abs(picture[chosen][:, :3] - expected).mean() < 0.01
            compared += int(chosen.sum())
    assert compared > 100


def test_folder_can_be_trained_on(folder: Path) -> None:
    model = load_dataset_model(folder)
    assert len(model.views) == 6 and len(model.points) > 40
    truth = read_ground_truth(folder / "truth.json")
    assert [map_path.name for _, map_path in truth.relit_folders] == ["dark.hdr"]
    assert truth.environment is not None
    assert np.allclose(read_environment(truth.environment), slope(map_directions(64)), atol=0.01)


@pytest.mark.exhaustive
def test_truths_put_into_a_run_bring_it_nearer_to_the_pictures(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    options = {**RUN_OPTIONS, "exports": [], "materials": True, "test_every": 0, "threads": 1}
    reconstruct(folder, tmp_path / "run", **options)
    arguments = ["material_losses", str(tmp_path / "run"), str(folder), "--views", "2", "--threads", "1"]
    monkeypatch.setattr(sys, "argv", arguments)
    material_losses.main()
    shares, rows = (read_table(text) for text in capsys.readouterr().out.split("\n| | all"))
    assert sum(shares["share of the pixels, %"]) == pytest.approx(100, abs=0.5)
    assert 50 < sum(shares["share of the squared error, %"]) < 100.5  # the rest is before the background
    assert len(rows) == 1 + 4 + 6 + 1
    truth = rows["geometry, normals, materials, environment"]
    assert truth[0] > rows["the run"][0] + 3
    matt = 1 + material_losses.REGIONS.index("matt")
    assert truth[matt] > 30 and truth[matt] > rows["the run"][matt] + 3


def read_table(text: str) -> dict[str, list[float]]:
    """Return the rows of numbers of a table in Markdown."""
    rows = [[cell.strip() for cell in line.strip("| ").split("|")] for line in text.splitlines()]
    numbers = {row[0]: ["nan" if cell == "-" else cell for cell in row[1:]] for row in rows}
    return {
        name: [float(cell) for cell in row]
        for name, row in numbers.items()
        if row and (row[-1] == "nan" or row[-1][-1:].isdigit())
    }


@pytest.mark.exhaustive
def test_things_and_skies_are_whole() -> None:
    assert set(CHOOSING) | set(REPORTING) == set(THINGS) and len(CHOOSING) == 2
    assert set((CHOOSING | REPORTING).values()) == set(SKIES)
    for make in THINGS.values():
        thing = make()
        corners = thing.vertices[thing.faces]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert ((across * thing.normals[thing.faces].mean(axis=1)).sum(axis=1) > 0).all()
        assert thing.albedo_linear.min() > 0 and thing.albedo_linear.max() <= 1
        assert thing.roughness.min() > 0.05 and thing.roughness.max() < 1
        assert set(np.unique(thing.metallic[[0, -1]])) <= {0.0, 1.0}
    for sky in SKIES.values():
        values = sky(32)
        assert values.shape == (32, 64, 3) and values.min() > 0
