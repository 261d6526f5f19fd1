"""Writing the cameras and points as a COLMAP model."""

from pathlib import Path

import numpy as np
import pycolmap

from octasplat.engine.dataset.synthetic.points import SurfacePoints
from octasplat.engine.dataset.synthetic.synthetic_views import SyntheticView


def write_model(
    folder: Path, camera: pycolmap.Camera, views: list[SyntheticView], points: SurfacePoints
) -> None:
    """Write a binary COLMAP model: one camera in one rig, an image and a frame a view, and the tracks."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    visible = np.isfinite(points.observed_px[..., 0])
    for k, view in enumerate(views):
        keypoints = points.observed_px[visible[:, k], k]
        image = pycolmap.Image(
            name=view.name,
            keypoints=np.ascontiguousarray(keypoints),
            camera_id=camera.camera_id,
            image_id=k + 1,
        )
        pose = pycolmap.Rigid3d(
            pycolmap.Rotation3d(view.rotation_cam_from_world), view.translation_cam_from_world
        )
        model.add_image_with_trivial_frame(image, pose)
    # A point's place among its image's observations: how many earlier points that image sees.
    places = np.cumsum(visible, axis=0) - 1
    for xyz, rgb, row, place in zip(points.xyz_world, points.rgb_srgb8, visible, places, strict=True):
        track = pycolmap.Track()
        for index in np.flatnonzero(row).tolist():
            track.add_element(index + 1, int(place[index]))
        model.add_point3D(xyz, track, rgb)
    model.update_point_3d_errors()
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)
