"""Shots, the images to render of a scene: its photographs' views, turntables and camera paths."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int64

from octasplat.engine.core.rays import ImageRays
from octasplat.engine.dataset import Camera, PosedView, Viewpoints
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.file_names import unique_render_names
from octasplat.engine.render.framing import fitting_distance, visible_bounds
from octasplat.engine.render.image_files import exr_layers, write_exr, write_png
from octasplat.engine.render.pinhole_camera import PinholeCamera, focal_from_fov
from octasplat.engine.render.pose_paths import Turntable, fit_turntable
from octasplat.engine.render.renderer import RenderedImage
from octasplat.engine.render.supersampling import (
    RADIANCE_RAYS_PER_SIDE,
    rays_per_pixel_side,
    render_averaged,
    render_filtered,
)
from octasplat.engine.shading.plain import PLAIN_SHADING
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.trace.protocol import Tracer

DEFAULT_FOV_Y_DEGREES = 50.0
_FOV_RANGE_DEGREES = (20.0, 90.0)
_ROWS_PER_BLOCK = 1 << 18
ELEVATION_DEGREES = 20.0


@dataclass(frozen=True)
class Shot:
    """One image to render.

    Attributes:
        name: relative path of its file, without a suffix.
        rays: makes the rays through its pixels.
    """

    name: str
    rays: Callable[[], ImageRays]


RenderFn = Callable[[Shot, Path, Callable[[float], None]], None]
"""Renders a shot and writes it to a file, whose suffix says the format; called with the share that is done.

It raises :class:`octasplat.engine.core.errors.OutputError` where the file cannot be written.
"""


def view_shots(
    viewpoints: Viewpoints, indices: Int64[np.ndarray, " n"], near_world: float = 0.0
) -> tuple[Shot, ...]:
    """Return the views of photographs with their lenses and names; rays start at ``near_world``."""
    names = unique_render_names([view.name for view in viewpoints.views])
    views = [(names[index], viewpoints.views[index]) for index in indices]
    return tuple(
        Shot(name, partial(_view_rays, view, viewpoints.cameras[view.camera_index], near_world))
        for name, view in views
    )


def camera_shots(cameras: Sequence[PinholeCamera]) -> tuple[Shot, ...]:
    """Return the views of cameras in sequence, named ``frame_0000`` and so on."""
    return tuple(Shot(f"frame_{number:04d}", camera.rays) for number, camera in enumerate(cameras))


def turntable_cameras(
    table: Turntable,
    frames: int,
    width_px: int,
    height_px: int,
    fov_y_degrees: float = DEFAULT_FOV_Y_DEGREES,
) -> tuple[PinholeCamera, ...]:
    """Return one turn of a turntable as cameras.

    Raises:
        ConfigError: there are no frames.
    """
    focal_px = focal_from_fov(fov_y_degrees, height_px)
    return tuple(
        PinholeCamera.from_pose(pose, width_px, height_px, fy_px=focal_px) for pose in table.poses(frames)
    )


def turntable_of_views(viewpoints: Viewpoints, gaussians: FlatGaussians) -> Turntable:
    """Return the turntable that fits the photographs' cameras.

    Its centre is the middle of the visible Gaussians where all cameras look the same way.

    Raises:
        ConfigError: the cameras share no up direction.
    """
    rotations = np.stack([view.rotation_cam_from_world for view in viewpoints.views])
    centres = np.stack([view.origin_world for view in viewpoints.views])
    ups = -rotations[:, 1]  # camera axes: +z is forward, -y is up
    return fit_turntable(
        centres,
        rotations[:, 2],
        ups,
        centre_if_parallel=lambda: visible_bounds(gaussians, ups.sum(axis=0)).centre_world,
    )


def fov_y_of_views(viewpoints: Viewpoints) -> float:
    """Return the first photograph's vertical field of view in degrees, clamped to a pinhole's range."""
    camera = viewpoints.cameras[viewpoints.views[0].camera_index]
    middle = camera.width_px / 2
    edges = camera.directions_cam(np.array([[middle, 0.0], [middle, float(camera.height_px)]]))
    slopes = edges[:, 1] / edges[:, 2]
    # Half an opening of a fisheye lens may be a right angle or more, where there is no slope.
    if not (np.isfinite(slopes).all() and (edges[:, 2] > 0).all()):
        return _FOV_RANGE_DEGREES[1]
    fov_degrees = 2 * np.degrees(np.arctan((slopes[1] - slopes[0]) / 2))
    return float(np.clip(fov_degrees, *_FOV_RANGE_DEGREES))


def gaussian_turntable(
    gaussians: FlatGaussians,
    *,
    up_world: Float64[np.ndarray, "3"] | None = None,
    fov_y_degrees: float = DEFAULT_FOV_Y_DEGREES,
    aspect: float = 1.0,
    elevation_degrees: float = ELEVATION_DEGREES,
) -> Turntable:
    """Return a turntable that shows all visible Gaussians of a scene without cameras.

    Args:
        gaussians: the scene.
        up_world: up; by default -y, as in most scenes that COLMAP made.
        fov_y_degrees: of the camera.
        aspect: width over height of the images.
        elevation_degrees: of the camera above the middle.
    """
    up = np.array([0.0, -1.0, 0.0]) if up_world is None else up_world
    bounds = visible_bounds(gaussians, up)
    distance = fitting_distance(bounds, elevation_degrees, fov_y_degrees, aspect)
    elevation = np.radians(elevation_degrees)
    radius, height = distance * np.cos(elevation), distance * np.sin(elevation)
    return Turntable(bounds.centre_world, bounds.up_world, float(radius), float(height))


def scene_render_fn(
    tracer: Tracer,
    background: Float32[np.ndarray, "3"],
    *,
    transparent: bool = False,
    trained_rad: float = 0.0,
    shading: ShadingModel = PLAIN_SHADING,
    gives_radiance: bool = False,
) -> RenderFn:
    """Return the function that renders a shot of a scene to a file.

    ``.exr`` gets linear R, G, B, alpha A, the expected distance Z (0 where nothing is) and the world normal
    N.x, N.y, N.z; anything else gets 8-bit display colors. Radiance above white is kept by EXR.

    Args:
        tracer: with the scene built.
        background: display color behind the scene.
        transparent: PNG get straight colors and alpha, EXR linear ones multiplied by alpha; the background
            should be black.
        trained_rad: angle of a pixel of the training views; larger pixels get several rays, so that what is
            smaller than they neither sparkles nor breaks up. 0 where it is not known: one ray each.
        shading: what develops the rays: a learnt background, or materials in their light.
        gives_radiance: whether ``shading`` has the layer ``linear``, whose means over a pixel are shown.
    """

    def paint(shot: Shot, path: Path, _part: Callable[[float], None]) -> None:
        is_exr = path.suffix.lower() == ".exr"
        image = scene_image(
            tracer,
            shot.rays(),
            background,
            trained_rad=trained_rad,
            shading=shading,
            gives_radiance=gives_radiance,
            max_radiance=np.inf if is_exr else 1.0,
        )
        if is_exr:
            layers = exr_layers(
                image.rgb_srgb,
                alpha=image.alpha,
                depth=image.depth,
                normals_world=image.normal_world,
                transparent=transparent,
            )
            write_exr(path, layers)
        elif transparent:
            straight = image.rgb_srgb / np.maximum(image.alpha, 1e-6)[..., None]
            write_png(path, np.clip(straight, 0, 1), image.alpha)
        else:
            write_png(path, image.rgb_srgb)

    return paint


def scene_image(
    tracer: Tracer,
    rays: ImageRays,
    background: Float32[np.ndarray, "3"],
    *,
    trained_rad: float,
    shading: ShadingModel,
    gives_radiance: bool,
    max_radiance: float = 1.0,
) -> RenderedImage:
    """Return a picture of a scene; all but ``max_radiance`` is as for :func:`scene_render_fn`.

    Args:
        tracer: with the scene built.
        rays: through the centres of the pixels.
        background: display color behind the scene.
        trained_rad: angle of a pixel of the training views, or 0.
        shading: what develops the rays.
        gives_radiance: whether ``shading`` has the layer ``linear``.
        max_radiance: where the radiance that a pixel collects is cut off.
    """
    side = rays_per_pixel_side(rays, trained_rad)
    if not gives_radiance:
        return render_averaged(tracer, rays, background, shading, side)
    side = max(side, RADIANCE_RAYS_PER_SIDE)
    return render_filtered(tracer, rays, background, shading, side, max_radiance=max_radiance)


def training_pixel_angle(viewpoints: Viewpoints) -> float:
    """Return the angle of the central pixel of the first training view, in radians."""
    return viewpoints.cameras[viewpoints.views[0].camera_index].pixel_angle_rad


def _view_rays(view: PosedView, camera: Camera, near_world: float) -> ImageRays:
    """Return all rays of a view; pixels that the camera cannot un-project look along its axis."""
    width, height = view.width_px, view.height_px
    directions_world = np.empty((height, width, 3), np.float32)
    rows = max(1, _ROWS_PER_BLOCK // width)
    for top in range(0, height, rows):
        y, x = np.mgrid[top : min(top + rows, height), 0:width] + 0.5
        directions = camera.directions_cam(np.stack([x.ravel(), y.ravel()], axis=1))
        # outside of the lens's range there is no direction
        directions[np.isnan(directions).any(axis=1)] = (0.0, 0.0, 1.0)
        world = directions @ view.rotation_cam_from_world
        directions_world[top : top + rows] = world.reshape(-1, width, 3)
    axis_world = view.rotation_cam_from_world[2]
    return ImageRays.from_directions(view.origin_world, directions_world, near_world, axis_world)
