"""What a picture of a scene of many Gaussians takes, and each further one of a film.

    python -m benchmarks.large_picture RUN [--gaussians 1000000] [--threads 2]

Each Gaussian of a finished run is replaced by a grid of smaller ones that cover the same area, until there
are ``--gaussians``, so that the picture stays about the same. ``octasplat render`` of one and of four
pictures of 1,920 x 1,080 pixels along the way of the photographs, in processes of their own: seconds and
CPU seconds of the first picture, reading the file and building the tree included, and of each further one.
"""

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from octasplat.engine.core.writing import write_json
from octasplat.engine.files import read_scene
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.gaussians.frames import rotation_matrices
from octasplat.engine.gaussians.model import FlatGaussians

SPREAD = 1.6
"""The grid of a Gaussian's parts reaches so many standard deviations to either side."""
OVERLAP = 1.1
"""Standard deviation of a part, of the distance between two of them."""
FILM = 4


def split(gaussians: FlatGaussians, count: int) -> FlatGaussians:
    """Return ``count`` smaller Gaussians in the places of all of ``gaussians``."""
    side = int(np.ceil(np.sqrt(count / len(gaussians))))
    steps = SPREAD * (2 * (np.arange(side) + 0.5) / side - 1)
    across, along = (grid.reshape(-1) for grid in np.meshgrid(steps, steps))
    axes, scales = rotation_matrices(gaussians.quats_wxyz), np.exp(gaussians.log_scales)
    offsets = [
        axes[:, None, :, k + 1] * (scales[:, None, k] * step)[..., None]
        for k, step in ((0, across), (1, along))
    ]
    means = (gaussians.means_world[:, None] + offsets[0] + offsets[1]).reshape(-1, 3)
    rows = np.sort(np.random.default_rng(0).permutation(len(means))[:count])
    parts = gaussians.select(rows // side**2)
    parts.means_world = means[rows].astype(np.float32)
    parts.log_scales = parts.log_scales + np.float32(np.log(OVERLAP * 2 * SPREAD / side))
    return parts


def camera_path(run: Path, frames: int) -> dict[str, Any]:
    """Return the content of a path along the views of a run, from the middle one on."""
    views = json.loads((run / "views.json").read_text())["views"]
    poses = []
    for view in views[len(views) // 2 :][:frames]:
        cam_from_world = np.eye(4)
        cam_from_world[:3, :3] = view["rotation_cam_from_world"]
        cam_from_world[:3, 3] = view["translation_cam_from_world"]
        poses.append({"camera_to_world": np.linalg.inv(cam_from_world).tolist(), "fov_y_degrees": 42.0})
    return {"width": 1920, "height": 1080, "fps": 24.0, "frames": poses}


def measured(command: list[str]) -> tuple[float, float]:
    """Return the seconds and CPU seconds of a command."""
    began = time.monotonic()
    pid = os.posix_spawn(command[0], command, os.environ)
    _, status, usage = os.wait4(pid, 0)
    assert status == 0
    return time.monotonic() - began, usage.ru_utime + usage.ru_stime


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--threads", type=int, default=2)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="octasplat-large-picture-") as folder:
        scene = Path(folder) / "scene.ply"
        gaussians, _ = read_scene(given.run)
        write_gaussian_ply(split(gaussians, given.gaussians), scene)

        def render(frames: int) -> tuple[float, float]:
            path, out = Path(folder) / f"{frames}.json", Path(folder) / f"out{frames}"
            write_json(path, camera_path(given.run, frames))
            shutil.rmtree(out, ignore_errors=True)
            command = [sys.executable, "-m", "octasplat", "render", str(scene), "--path", str(path)]
            return measured([*command, "--threads", str(given.threads), "--quiet", "-o", str(out)])

        render(1)  # compiles
        first, film = render(1), render(FILM)
    for name, one, all_of_them in zip(("seconds", "CPU seconds"), first, film, strict=True):
        print(f"{name}: first picture {one:.1f}, each further one {(all_of_them - one) / (FILM - 1):.1f}")


if __name__ == "__main__":
    main()
