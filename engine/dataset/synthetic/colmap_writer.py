"""Writing the cameras and points as a COLMAP model."""

from pathlib import Path

import numpy as np

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.dataset.synthetic.points import SurfacePoints
from octasplat.engine.dataset.synthetic.synthetic_views import SyntheticView


def write_model(
    folder: Path, camera: pycolmap.Camera, views: list[SyntheticView], points: SurfacePoints
) -> None:
    """Write a binary COLMAP model: one camera in one rig, an image and a frame a view, and the tracks."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    by_view = np.argsort(points.observing_views, kind="stable")
    starts = np.searchsorted(points.observing_views[by_view], np.arange(len(views) + 1))
    # A point's place among its image's observations: how many earlier points that image sees.
    places = np.empty(len(by_view), np.int64)
    places[by_view] = np.arange(len(by_view)) - starts[points.observing_views[by_view]]
    for k, view in enumerate(views):
        keypoints = points.observed_px[by_view[starts[k] : starts[k + 1]]]
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
    ends = np.searchsorted(points.observed_points, np.arange(len(points.xyz_world) + 1))
    for k, (xyz, rgb) in enumerate(zip(points.xyz_world, points.rgb_srgb8, strict=True)):
        track = pycolmap.Track()
        for observation in range(ends[k], ends[k + 1]):
            track.add_element(int(points.observing_views[observation]) + 1, int(places[observation]))
        model.add_point3D(xyz, track, rgb)
    model.update_point_3d_errors()
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)
