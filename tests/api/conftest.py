"""A small scene that the examples of the documentation and the tests of the package work on."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.gaussians.frames import frames_from_normals, quaternions
from octasplat.engine.gaussians.harmonics import spread_directions
from octasplat.engine.gaussians.model import FlatGaussians

COUNT = 1200


def small_scene() -> FlatGaussians:
    """A ball of radius 1, whose colours say where the surface faces."""
    normals = spread_directions(COUNT).astype(np.float32)
    random = np.random.default_rng(4)
    sh = np.zeros((COUNT, 4, 3), np.float32)
    sh[:, 0] = normals
    sh[:, 1:] = 0.1 * random.standard_normal((COUNT, 3, 3))
    return FlatGaussians(
        means_world=normals.copy(),
        quats_wxyz=quaternions(frames_from_normals(normals)),
        log_scales=np.log(random.uniform(0.03, 0.05, (COUNT, 2))).astype(np.float32),
        opacity_logits=random.uniform(-1, 4, COUNT).astype(np.float32),
        sh=sh,
    )


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    """The scene as a file."""
    path = tmp_path / "scene.ply"
    write_gaussian_ply(small_scene(), path)
    return path


@pytest.fixture
def in_folder(scene_file: Path) -> Iterator[Path]:
    """The folder that holds ``scene.ply``, as the current one."""
    before = Path.cwd()
    os.chdir(scene_file.parent)
    yield scene_file.parent
    os.chdir(before)
