"""Pixels lifted to points: they lie on the surfaces that the photographs show, in the colors shown there."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial import cKDTree

from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.dataset.synthetic.still_life import build_still_life
from octasplat.engine.render.image_files import write_png
from octasplat.engine.train.initialization.initial_background import estimate_background
from octasplat.engine.train.initialization.plane_sweep import plane_sweep_points
from octasplat.engine.train.initialization.plane_sweep_points import PlaneSweepPoints
from octasplat.engine.train.views.exposure_changes import equalizing_gains


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    root: Path = tmp_path_factory.mktemp("lifted")
    config = SyntheticDatasetConfig(views=24, width_px=160, height_px=120, points=1500, samples_per_side=1)
    write_synthetic_dataset(root / "scene", config)
    return Dataset.open(root / "scene", root / "cache")


@pytest.fixture(scope="module")
def surface() -> cKDTree:
    """300,000 points spread over the true surfaces, some 2 cm apart."""
    rng = np.random.default_rng(1)
    scene = build_still_life()
    corners = scene.vertices.astype(np.float64)[scene.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = rng.choice(len(corners), 300_000, p=areas / areas.sum())
    return cKDTree(np.einsum("nk,nkc->nc", rng.dirichlet([1, 1, 1], len(chosen)), corners[chosen]))


def assert_same(first: PlaneSweepPoints, second: PlaneSweepPoints) -> None:
    for name, values in vars(first).items():
        assert np.array_equal(values, getattr(second, name)), name


def test_points_lie_on_the_surfaces(dataset: Dataset, surface: cKDTree) -> None:
    lifted = plane_sweep_points(dataset, 3000, np.random.default_rng(0))
    xyz, rgb = lifted.xyz_world, lifted.rgb_srgb
    assert 1500 < len(xyz) <= 3000
    assert xyz.dtype == rgb.dtype == np.float32
    off, _ = surface.query(xyz.astype(np.float64))
    # The room is 7 m wide; the table has a radius of 1 m.
    assert np.median(off) < 0.06
    assert (off < 0.3).mean() > 0.85


def test_points_have_the_color_of_their_pixels(dataset: Dataset) -> None:
    lifted = plane_sweep_points(dataset, 1000, np.random.default_rng(0))
    xyz, rgb = lifted.xyz_world, lifted.rgb_srgb
    best = np.full(len(xyz), np.inf)
    for index in dataset.train_indices:
        view = dataset.views[index]
        points_cam = xyz @ view.rotation_cam_from_world.T + view.translation_cam_from_world
        where = np.floor(dataset.cameras[view.camera_index].project(points_cam.astype(np.float64)))
        inside = ((where >= 0) & (where < [view.width_px, view.height_px])).all(axis=1) & (
            points_cam[:, 2] > 0
        )
        pixel = where[inside].astype(np.int64)
        shown, _, _ = dataset.pixels(np.full(len(pixel), index), pixel[:, 1], pixel[:, 0])
        best[inside] = np.minimum(best[inside], np.abs(shown - rgb[inside]).max(axis=1))
    # Each was taken from some view; projecting it back may land one pixel beside.
    assert (best < 1e-3).mean() > 0.9


def without_points_of_the_table(dataset: Dataset, folder: Path) -> tuple[Dataset, np.ndarray]:
    """The same photographs, in whose model nothing stands within a metre of the table; what stands there."""
    model = pycolmap.Reconstruction(str(dataset.root / "sparse" / "0"))
    on_table = [k for k, point in model.points3D.items() if np.linalg.norm(point.xyz[:2]) < 1.0]
    gone = np.stack([model.points3D[k].xyz for k in on_table])
    for k in on_table:
        model.delete_point3D(k)
    shutil.copytree(dataset.root, folder / "scene")
    model.write(str(folder / "scene" / "sparse" / "0"))
    return Dataset.open(folder / "scene", folder / "cache"), gone


@pytest.mark.exhaustive
def test_dense_points_cover_objects_without_sparse_points(
    dataset: Dataset, surface: cKDTree, tmp_path: Path
) -> None:
    bare, gone = without_points_of_the_table(dataset, tmp_path)
    assert len(gone) > 200 and len(bare.points) < len(dataset.points) - 200
    lifted = plane_sweep_points(bare, 20_000, np.random.default_rng(0))
    near = np.linalg.norm(lifted.xyz_world[:, :2], axis=1) < 1.0
    off, _ = surface.query(lifted.xyz_world.astype(np.float64))
    right = off < 0.1
    assert (near & right).sum() > 3000
    assert (near & right & lifted.swept).sum() > 100
    assert right[lifted.swept].mean() > 0.75 and right.mean() > 0.85


@pytest.mark.exhaustive
def test_dense_points_single_view_option_lifts_pixels(surface: cKDTree, tmp_path: Path) -> None:
    config = SyntheticDatasetConfig(views=6, width_px=160, height_px=120, points=1500, samples_per_side=1)
    write_synthetic_dataset(tmp_path / "scene", config)
    few = Dataset.open(tmp_path / "scene", tmp_path / "cache")
    matched, all_of_them = (
        plane_sweep_points(few, 4000, np.random.default_rng(0), unseen=unseen) for unseen in (False, True)
    )
    assert len(all_of_them) > 1.4 * len(matched)
    off, _ = surface.query(all_of_them.xyz_world.astype(np.float64))
    # Between the points around them: right on walls and floor, not where things end.
    assert (off < 0.1).mean() > 0.6 and (off < 0.3).mean() > 0.75


@pytest.mark.exhaustive
def test_dense_matching_with_uneven_exposure(dataset: Dataset, tmp_path: Path) -> None:
    shutil.copytree(dataset.root, tmp_path / "scene")
    darker = np.where(np.arange(len(dataset.views)) % 3 == 1, 0.55, 1.0).astype(np.float32)
    for index, view in enumerate(dataset.views):
        rgb, _, _ = dataset.view_image(index)
        write_png(tmp_path / "scene" / "images" / view.name, rgb * darker[index])
    uneven = Dataset.open(tmp_path / "scene", tmp_path / "cache")
    gains = equalizing_gains(uneven)
    even = gains * darker / np.median(gains * darker)
    assert np.abs(np.log(even[uneven.train_indices])).max() < 0.12
    found = [len(plane_sweep_points(uneven, 3000, np.random.default_rng(0), gains=g)) for g in (None, gains)]
    assert found[1] > 1.1 * found[0]
    before = len(plane_sweep_points(dataset, 3000, np.random.default_rng(0)))
    assert found[1] > 0.9 * before


def test_dense_points_are_deterministic_for_seed(dataset: Dataset) -> None:
    first, second = (plane_sweep_points(dataset, 500, np.random.default_rng(3)) for _ in range(2))
    assert_same(first, second)


def test_dense_points_count_zero_is_empty(dataset: Dataset) -> None:
    nothing = plane_sweep_points(dataset, 0, np.random.default_rng(0))
    assert len(nothing) == 0 and nothing.xyz_world.shape == nothing.rgb_srgb.shape == (0, 3)


@pytest.mark.exhaustive
def test_dense_points_independent_of_threads(dataset: Dataset) -> None:
    one, three = (plane_sweep_points(dataset, 800, np.random.default_rng(3), threads=n) for n in (1, 3))
    assert len(one) > 300 and one.swept.any()
    assert_same(one, three)


@pytest.mark.exhaustive
def test_dense_points_skip_sky(dataset: Dataset, tmp_path: Path) -> None:
    """Photographs that show the same color in a direction from wherever they are: all sky."""
    shutil.copytree(dataset.root, tmp_path / "scene")
    for index, view in enumerate(dataset.views):
        ways = dataset.view_rays(index).directions_world.astype(np.float64)
        colors = 0.5 + 0.3 * np.sin(3 * ways)
        write_png(tmp_path / "scene" / "images" / view.name, colors.astype(np.float32))
    under_sky = Dataset.open(tmp_path / "scene", tmp_path / "cache")
    # As if up were where the cameras look, so that nearly all that they see is above the horizon.
    ahead = np.mean([view.rotation_cam_from_world[2] for view in dataset.views], axis=0)
    over = replace(estimate_background(under_sky), up_world=ahead)
    rng = np.random.default_rng
    lifted = [len(plane_sweep_points(under_sky, 500, rng(0), background=behind)) for behind in (None, over)]
    # What the neighbouring views do not show at infinity, as they look inwards, may still be near.
    assert lifted[0] > 250 and lifted[1] < 0.8 * lifted[0]


@pytest.mark.exhaustive
def test_dense_points_near_surface_with_background_are_lifted(dataset: Dataset) -> None:
    plain = plane_sweep_points(dataset, 1000, np.random.default_rng(0))
    before = plane_sweep_points(
        dataset, 1000, np.random.default_rng(0), background=estimate_background(dataset)
    )
    assert len(before) > 0.9 * len(plain)


@pytest.mark.exhaustive
def test_dense_points_compensate_for_empty_pixels(dataset: Dataset, tmp_path: Path) -> None:
    shutil.copytree(dataset.root, tmp_path / "scene")
    masks = tmp_path / "scene" / "masks"
    masks.mkdir()
    seen = np.zeros((120, 160, 3), np.float32)
    seen[30:90, 50:110] = 1  # 19 % of the picture
    for view in dataset.views:
        write_png(masks / f"{view.name}.png", seen)
    masked = Dataset.open(tmp_path / "scene", tmp_path / "cache")
    whole, part = (
        len(plane_sweep_points(data, 1000, np.random.default_rng(0))) for data in (dataset, masked)
    )
    assert part > 0.7 * whole
