"""Series of images of a scene: its photographs' views, turntables and paths, to image files or a video."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int64

from engine.gaussians.model import FlatGaussians
from engine.rays import ImageRays
from engine.render.cameras import RenderCamera, focal_from_fov
from engine.render.framing import fitting_distance, seen_bounds
from engine.render.images import exr_layers, write_exr, write_png
from engine.render.names import render_names
from engine.render.paths import Turntable, fit_turntable
from engine.render.renderer import RenderedImage, render_rays
from engine.render.video import VideoWriter
from engine.scene import Camera, PosedView, Viewpoints
from engine.trace.protocol import Tracer

Progress = Callable[[int, int], None]

DEFAULT_FOV_Y_DEGREES = 50.0
_FOV_RANGE_DEGREES = (20.0, 90.0)
_ROWS_OF_RAYS = 1 << 18
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


def view_shots(
    scene: Viewpoints, indices: Int64[np.ndarray, " n"], near_world: float = 0.0
) -> tuple[Shot, ...]:
    """The views of photographs, with their lenses, named like them; nothing nearer than ``near_world``."""
    names = render_names([view.name for view in scene.views])
    views = [(names[index], scene.views[index]) for index in indices]
    return tuple(
        Shot(name, partial(_view_rays, view, scene.cameras[view.camera_index], near_world))
        for name, view in views
    )


def camera_shots(cameras: Sequence[RenderCamera]) -> tuple[Shot, ...]:
    """Views of cameras one after another, named ``frame_0000`` and so on."""
    return tuple(Shot(f"frame_{number:04d}", camera.rays) for number, camera in enumerate(cameras))


def turntable_cameras(
    table: Turntable,
    frames: int,
    width_px: int,
    height_px: int,
    fov_y_degrees: float = DEFAULT_FOV_Y_DEGREES,
) -> tuple[RenderCamera, ...]:
    """One turn of a turntable as cameras.

    Raises:
        ConfigError: there are no frames.
    """
    focal_px = focal_from_fov(fov_y_degrees, height_px)
    return tuple(
        RenderCamera.from_pose(pose, width_px, height_px, fy_px=focal_px) for pose in table.poses(frames)
    )


def scene_turntable(scene: Viewpoints) -> Turntable:
    """The turntable that fits where the photographs were taken.

    Raises:
        ConfigError: the cameras share no centre or no up direction.
    """
    rotations = np.stack([view.rotation_cam_from_world for view in scene.views])
    centres = np.stack([view.origin_world for view in scene.views])
    return fit_turntable(centres, rotations[:, 2], -rotations[:, 1])


def scene_fov_y_degrees(scene: Viewpoints) -> float:
    """The angle from the top to the bottom of the first photograph, kept within what a pinhole shows well."""
    camera = scene.cameras[scene.views[0].camera_index]
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
    """A turntable for a scene of which nothing but its Gaussians is known: all that is seen of it fits.

    Args:
        gaussians: the scene.
        up_world: up; by default -y, as in most scenes that COLMAP made.
        fov_y_degrees: of the camera.
        aspect: width over height of the images.
        elevation_degrees: of the camera above the middle.
    """
    up = np.array([0.0, -1.0, 0.0]) if up_world is None else up_world
    bounds = seen_bounds(gaussians, up)
    distance = fitting_distance(bounds, elevation_degrees, fov_y_degrees, aspect)
    elevation = np.radians(elevation_degrees)
    radius, height = distance * np.cos(elevation), distance * np.sin(elevation)
    return Turntable(bounds.centre_world, bounds.up_world, float(radius), float(height))


def render_images(
    tracer: Tracer,
    shots: Sequence[Shot],
    file_of: Callable[[int, Shot], Path],
    background: Float32[np.ndarray, "3"],
    progress: Progress = lambda _done, _total: None,
    *,
    transparent: bool = False,
) -> tuple[Path, ...]:
    """Render each shot to a file of its own.

    Args:
        tracer: with the scene built.
        shots: what to render.
        file_of: the file of a shot, given its number and itself. ``.exr`` gets linear R, G, B, alpha A, the
            expected distance Z (0 where nothing is) and the world normal N.x, N.y, N.z; anything else gets
            8-bit display colours.
        background: display colour behind the scene.
        progress: told (images done, images in all).
        transparent: PNG get straight colours and alpha; the background should be black.

    Returns:
        The files.

    Raises:
        OutputError: a file cannot be written.
    """
    paths = []
    for number, shot, image in _rendered(tracer, shots, background, progress):
        path = file_of(number, shot)
        if path.suffix.lower() == ".exr":
            layers = exr_layers(
                image.rgb_srgb, alpha=image.alpha, depth=image.depth, normals_world=image.normal_world
            )
            write_exr(path, layers)
        elif transparent:
            straight = image.rgb_srgb / np.maximum(image.alpha, 1e-6)[..., None]
            write_png(path, np.clip(straight, 0, 1), image.alpha)
        else:
            write_png(path, image.rgb_srgb)
        paths.append(path)
    return tuple(paths)


def render_video(
    tracer: Tracer,
    cameras: Sequence[RenderCamera],
    path: Path,
    fps: float,
    background: Float32[np.ndarray, "3"],
    progress: Progress = lambda _done, _total: None,
) -> None:
    """Render cameras of one image size as the frames of a video.

    Raises:
        OutputError: the video cannot be written.
    """
    first = cameras[0]
    with VideoWriter(path, fps, first.width_px, first.height_px) as video:
        for _, _, image in _rendered(tracer, camera_shots(cameras), background, progress):
            video.write(image.rgb_srgb)


def _rendered(
    tracer: Tracer, shots: Sequence[Shot], background: Float32[np.ndarray, "3"], progress: Progress
) -> Iterator[tuple[int, Shot, RenderedImage]]:
    progress(0, len(shots))
    for number, shot in enumerate(shots):
        yield number, shot, render_rays(tracer, shot.rays(), background)
        progress(number + 1, len(shots))


def _view_rays(view: PosedView, camera: Camera, near_world: float) -> ImageRays:
    """All rays of a view; pixels that the camera cannot un-project look along its axis."""
    width, height = view.width_px, view.height_px
    directions_world = np.empty((height, width, 3), np.float32)
    rows = max(1, _ROWS_OF_RAYS // width)
    for top in range(0, height, rows):
        y, x = np.mgrid[top : min(top + rows, height), 0:width] + 0.5
        directions = camera.directions_cam(np.stack([x.ravel(), y.ravel()], axis=1))
        directions[np.isnan(directions).any(axis=1)] = (0.0, 0.0, 1.0)
        world = directions @ view.rotation_cam_from_world
        directions_world[top : top + rows] = world.reshape(-1, width, 3)
    return ImageRays.of(view.origin_world, directions_world, near_world)
