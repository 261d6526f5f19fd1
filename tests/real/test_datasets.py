import os
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from octasplat.engine.dataset import Dataset, load_dataset_model

SCENES = os.environ.get("OCTASPLAT_SCENES")

pytestmark = [
    pytest.mark.real,
    pytest.mark.skipif(
        SCENES is None, reason="OCTASPLAT_SCENES does not name a folder of photographed scenes"
    ),
]


def scene_folders() -> list[Path]:
    if SCENES is None:
        return [Path("none")]
    return sorted(path for path in Path(SCENES).iterdir() if (path / "images").is_dir())


@pytest.mark.exhaustive
@pytest.mark.parametrize("root", scene_folders(), ids=lambda path: path.name)
def test_sparse_points_have_the_colors_of_the_photographs(root, tmp_path):
    """Where structure from motion saw a point, its color is found, which proves frames, rays and pixels."""
    data = Dataset.open(root, tmp_path / "cache", max_side=200)
    assert len(data.points) > 0
    model = pycolmap.Reconstruction(str(load_dataset_model(root).model_folder))
    seen_by = {image.name: image for image in model.images.values()}
    differences: list[np.ndarray] = []
    misses_px: list[np.ndarray] = []
    for index in range(0, len(data.views), max(1, len(data.views) // 8)):
        view = data.views[index]
        observed = [model.points3D[p.point3D_id] for p in seen_by[view.name].get_observation_points2D()]
        xyz = np.array([point.xyz for point in observed])
        color = np.array([point.color for point in observed]) / 255
        camera = data.cameras[view.camera_index]
        cam = xyz @ view.rotation_cam_from_world.T + view.translation_cam_from_world
        xy = camera.project(cam)
        inside = (cam[:, 2] > 0) & (xy >= 0).all(axis=1) & (xy < [view.width_px, view.height_px]).all(axis=1)
        assert inside.mean() > 0.99
        x, y = xy[inside].astype(int).T
        rgb, _, weight = data.pixels(np.full(len(x), index), y, x)
        differences.append(np.abs(rgb - color[inside])[weight == 1].mean(axis=1))
        # The ray through that pixel must pass within half a pixel's diagonal of the point.
        rays = data.rays(np.full(len(x), index), y, x)
        origins, directions = rays.origins_world, rays.directions_world
        offsets = xyz[inside] - origins
        along = (offsets * directions).sum(axis=1, keepdims=True)
        across = np.linalg.norm(offsets - along * directions, axis=1)
        misses_px.append(across / cam[inside, 2] * max(camera.pinhole_params[:2]))
    assert len(np.concatenate(differences)) > 100
    if not (root / "truth.json").exists():  # those are of shiny things, which look otherwise from each side
        assert float(np.median(np.concatenate(differences))) < 0.1
    assert float(np.concatenate(misses_px).max()) < 0.75
