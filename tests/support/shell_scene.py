"""A small scene for other programs to draw: a ball of flat Gaussians, seen by two cameras."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from octasplat.engine.gaussians.frames import (
    frames_from_normals,
    quaternions_from_matrices,
    rotation_matrices,
)
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians
from octasplat.engine.render.image_files import read_image
from octasplat.engine.render.path_file import CameraPath
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.engine.render.renderer import background_color, render_rays
from octasplat.engine.trace.cpu.tracer import CpuTracer
from octasplat.engine.trace.protocol import TraceSettings
from tests.support.camera_paths import write_camera_path

WIDTH_PX, HEIGHT_PX = 256, 192


def shell_scene(count: int = 300, seed: int = 4) -> FlatGaussians:
    """Gaussians on a shell of radius 0.9 to 1, lying roughly along it, of all opacities and colors."""
    random = np.random.default_rng(seed)
    outward = random.normal(size=(count, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    normals = outward + random.normal(scale=0.3, size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    opacities = random.uniform(0.1, 0.98, count)
    parts = (
        outward * random.uniform(0.9, 1.0, (count, 1)),
        quaternions_from_matrices(frames_from_normals(normals)),
        np.log(random.uniform(0.02, 0.06, (count, 2)) * np.sqrt(300 / count)),
        np.log(opacities / (1 - opacities)),
        (random.uniform(0.05, 0.95, (count, 1, 3)) - 0.5) / SH_C0,
    )
    return FlatGaussians(*(part.astype(np.float32) for part in parts))


def shell_cameras() -> tuple[PinholeCamera, ...]:
    """One camera in front and one that is shifted and turned; axes off the middle, pixels not square."""
    first, second = np.eye(4), np.eye(4)
    first[:3, 3] = (0.0, 0.0, -2.6)
    half_angles = np.array([[1.0, 0.1, 0.12, 0.2]])
    second[:3, :3] = rotation_matrices(half_angles)[0]
    second[:3, 3] = second[:3, :3] @ (0.1, -0.2, -2.4)
    optics = {"fy_px": 200.0, "fx_px": 220.0, "cx_px": 120.0, "cy_px": 101.0}
    return tuple(PinholeCamera.from_pose(pose, WIDTH_PX, HEIGHT_PX, **optics) for pose in (first, second))


def write_shell_cameras(path: Path) -> None:
    """The cameras as the JSON that all viewers of the tests read."""
    write_camera_path(path, CameraPath(30.0, shell_cameras()))


def our_view(scene: FlatGaussians, camera: PinholeCamera) -> Float32[np.ndarray, "h w 3"]:
    """What our tracer sees over black, with nothing cut short."""
    tracer = CpuTracer(TraceSettings(transmittance_min=1e-6, alpha_max=0.9999), threads=1)
    tracer.build(scene)
    return render_rays(tracer, camera.rays(), background_color("black")).rgb_srgb


def psnr_db(path: Path, expected: Float32[np.ndarray, "h w 3"]) -> float:
    """Agreement of an image file with an expected image, in dB."""
    seen = read_image(path)[..., :3]
    assert seen.shape == expected.shape
    assert expected.max() > 0.5, "the scene is in the picture"
    return float(-10 * np.log10(np.mean((seen - expected) ** 2)))
