"""The generated street: its files agree with each other, its views cover it; earlier folders are taken."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pycolmap
import pytest

from octasplat.engine.core.errors import ConfigError, DatasetError
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.dataset.synthetic.street import FACADE_Y, LOT, build_street, half_length

VIEWS = 32
HOUSES = 8
STREET = SyntheticDatasetConfig(
    views=VIEWS, width_px=96, height_px=72, samples_per_side=1, points=600, scene="street"
)


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("street") / "scene"
    write_synthetic_dataset(root, STREET)
    return root


def read_depth(street: Path, name: str) -> np.ndarray:
    source = oiio.ImageInput.open(str(street / "ground_truth" / "depth" / f"{Path(name).stem}.exr"))
    depth = np.asarray(source.read_image("float")).reshape(STREET.height_px, STREET.width_px)
    source.close()
    return depth


@pytest.mark.exhaustive
def test_tracks_reproject_and_lie_on_what_is_seen(street: Path) -> None:
    model = pycolmap.Reconstruction(str(street / "sparse" / "0"))
    assert (model.num_reg_images(), model.num_points3D()) == (VIEWS, 600)
    depths = {image.image_id: read_depth(street, image.name) for image in model.images.values()}
    offsets = []
    for point in model.points3D.values():
        assert point.track.length() >= 2
        for element in point.track.elements:
            image = model.images[element.image_id]
            observed = image.points2D[element.point2D_idx]
            assert observed.point3D_id in model.points3D
            assert np.linalg.norm(image.project_point(point.xyz) - observed.xy) < 0.5
            column, row = np.floor(observed.xy).astype(int)
            z = (image.cam_from_world() * point.xyz)[2]
            offsets.append(abs(z - depths[element.image_id][row, column]) / z)
    assert np.median(offsets) < 0.03  # the ground is seen at a flat angle


@pytest.mark.exhaustive
def test_every_house_is_photographed_from_several_places(street: Path) -> None:
    model = pycolmap.Reconstruction(str(street / "sparse" / "0"))
    centres = np.array([image.projection_center() for image in model.images.values()])
    assert np.ptp(centres[:, 0]) > 80 and (np.abs(centres[:, 1]) < 3).all() and (centres[:, 2] > 1.4).all()
    end = half_length(HOUSES)
    seen: dict[tuple[int, bool], set[int]] = {}
    for point in model.points3D.values():
        x, y, _ = point.xyz
        if abs(x) < end and abs(y) > FACADE_Y - 0.1:
            place = (int((x + end) / LOT), bool(y > 0))
            seen.setdefault(place, set()).update(element.image_id for element in point.track.elements)
    assert len(seen) == 2 * HOUSES
    assert min(map(len, seen.values())) >= 2


@pytest.mark.parametrize("count", [2, HOUSES])
def test_houses_do_not_overlap_and_stand_on_the_ground(count: int) -> None:
    houses = [thing for thing in build_street(count).objects if thing.name.startswith("house")]
    boxes = np.array([[thing.mesh.vertices.min(axis=0), thing.mesh.vertices.max(axis=0)] for thing in houses])
    assert len(houses) == 2 * count
    np.testing.assert_allclose(boxes[:, 0, 2], 0, atol=1e-6)
    for k, (low, high) in enumerate(boxes):
        others = np.delete(boxes, k, axis=0)
        assert not ((others[:, 0, :2] < high[:2]) & (others[:, 1, :2] > low[:2])).all(axis=1).any()


@pytest.mark.exhaustive
def test_names_sort_in_the_order_of_the_views(tmp_path: Path) -> None:
    config = SyntheticDatasetConfig(
        views=1001, width_px=8, height_px=8, samples_per_side=1, points=5, scene="street"
    )
    write_synthetic_dataset(tmp_path / "many", config)
    names = sorted(path.name for path in (tmp_path / "many" / "images").iterdir())
    assert (len(names), names[0], names[-1]) == (1001, "view_0000.png", "view_1000.png")


def test_folder_of_an_earlier_version_is_the_still_life(tmp_path: Path) -> None:
    config = SyntheticDatasetConfig(views=3, width_px=8, height_px=8)
    record = config.as_dict()
    del record["scene"]
    (tmp_path / "generated.json").write_text(json.dumps({"version": 1, "config": record}))
    write_synthetic_dataset(tmp_path, config)
    with pytest.raises(DatasetError, match="other settings"):
        write_synthetic_dataset(tmp_path, replace(config, scene="street"))


def test_unknown_scene_is_refused() -> None:
    with pytest.raises(ConfigError, match="scene is 'moon'"):
        SyntheticDatasetConfig(scene="moon")
