"""Cameras of every COLMAP model, used as rays through pixels; images are never undistorted."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.colmap_binding import pycolmap

ROUND_TRIP_TOLERANCE_PX = 0.1
"""Directions that project back farther than this from their pixel are not un-projections at all."""

_TWO_FOCAL_MODELS = {
    "SIMPLE_PINHOLE": "PINHOLE",
    "SIMPLE_RADIAL": "OPENCV",
    "RADIAL": "OPENCV",
    "SIMPLE_RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "SIMPLE_DIVISION": "DIVISION",
    "SIMPLE_FISHEYE": "FISHEYE",
}
"""The model with separate fx and fy whose parameters continue those of a model with one focal length."""


@dataclass(frozen=True)
class Camera:
    """Intrinsics of one camera at one image size.

    Attributes:
        model: COLMAP's name of the camera model.
        params: its parameters in COLMAP's order, pixels where they are lengths.
        width_px: image width the parameters belong to.
        height_px: image height the parameters belong to.
    """

    model: str
    params: tuple[float, ...]
    width_px: int
    height_px: int

    @property
    def is_pinhole(self) -> bool:
        """Return whether focal lengths and principal point alone determine the rays."""
        return self.model in ("SIMPLE_PINHOLE", "PINHOLE")

    @property
    def pinhole_params(self) -> tuple[float, float, float, float]:
        """Return the parameters (fx, fy, cx, cy) of a pinhole camera, in pixels.

        Raises:
            ValueError: the camera is not a pinhole camera.
        """
        if self.model == "PINHOLE":
            fx, fy, cx, cy = self.params
            return fx, fy, cx, cy
        if self.model == "SIMPLE_PINHOLE":
            f, cx, cy = self.params
            return f, f, cx, cy
        raise ValueError(f"{self.model} is not a pinhole model")

    @property
    def pixel_angle_rad(self) -> float:
        """Return the angle of a pixel at the image centre; 0 where the model has no rays there."""
        x, y = self.width_px / 2, self.height_px / 2
        ways = self.directions_cam(np.array([[x, y], [x + 1, y]]))
        angle = float(np.linalg.norm(np.cross(ways[0], ways[1])))  # the sine, for so small an angle
        return angle if np.isfinite(angle) else 0.0

    @property
    def is_panorama(self) -> bool:
        """Return whether the image covers the whole sphere; other models cover only what lies ahead."""
        return self.model == "EQUIRECTANGULAR"

    def to_pycolmap(self) -> "pycolmap.Camera":
        """Return the camera as a ``pycolmap.Camera``."""
        return pycolmap.Camera(
            model=self.model, width=self.width_px, height=self.height_px, params=list(self.params)
        )

    def scaled_to(self, width_px: int, height_px: int) -> "Camera":
        """Return the camera of the same photograph resized, with the exact ratio along each axis.

        A model with one focal length turns into its sibling with two where the ratios differ.

        >>> Camera("PINHOLE", (100.0, 100.0, 50.0, 40.0), 100, 80).scaled_to(50, 40).params
        (50.0, 50.0, 25.0, 20.0)
        """
        if (width_px, height_px) == (self.width_px, self.height_px):
            return self
        ratio_x, ratio_y = width_px / self.width_px, height_px / self.height_px
        camera = self.to_pycolmap()
        if ratio_x != ratio_y and self.model in _TWO_FOCAL_MODELS:
            f, cx, cy, *extra = self.params
            camera = pycolmap.Camera.create_from_model_name(
                0, _TWO_FOCAL_MODELS[self.model], f, self.width_px, self.height_px
            )
            params = [f, f, cx, cy, *extra]
            # Terms of distortion that only the sibling has are 0.
            camera.params = params + [0.0] * (len(camera.params) - len(params))
        camera.rescale(width_px, height_px)
        return Camera(camera.model_name, tuple(float(p) for p in camera.params), width_px, height_px)

    def directions_cam(self, xy_px: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
        """Return unit directions through image points, in camera coordinates.

        Args:
            xy_px: image points; the centre of the pixel in column x and row y is (x + 0.5, y + 0.5).

        Returns:
            Unit vectors; not-a-number where the model has no ray for the point. A direction counts only if
            it projects back onto its point: some models answer with a wrong one beyond their field of view.

        >>> camera = Camera("PINHOLE", (100.0, 100.0, 50.0, 40.0), 100, 80)
        >>> camera.directions_cam(np.array([[50.0, 40.0], [150.0, 40.0]])).round(4).tolist()
        [[0.0, 0.0, 1.0], [0.7071, 0.0, 0.7071]]
        """
        if self.is_pinhole:
            fx, fy, cx, cy = self.pinhole_params
            rays = np.stack([(xy_px[:, 0] - cx) / fx, (xy_px[:, 1] - cy) / fy, np.ones(len(xy_px))], axis=1)
            return rays / np.linalg.norm(rays, axis=1, keepdims=True)
        camera = self.to_pycolmap()
        points = np.ascontiguousarray(xy_px)
        directions = np.array(camera.cam_ray_from_img(points), dtype=np.float64).reshape(-1, 3)
        misses_px = np.abs(np.asarray(camera.img_from_cam(directions)).reshape(-1, 2) - points).max(
            axis=1, initial=0.0
        )
        # Negated, as a projection that is not-a-number must count as a miss
        directions[~(misses_px <= ROUND_TRIP_TOLERANCE_PX)] = np.nan
        return directions

    def project(self, points_cam: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
        """Project points in camera coordinates to pixels; not-a-number where there is no projection."""
        return np.array(_projector(self).img_from_cam(np.ascontiguousarray(points_cam)), dtype=np.float64)


@lru_cache(maxsize=4096)
def _projector(camera: Camera) -> "pycolmap.Camera":
    """Return COLMAP's form of a camera to project with; making one takes as long as a thousand points."""
    return camera.to_pycolmap()
