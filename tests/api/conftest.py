"""A small scene that the examples of the documentation and the tests of the package work on."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import octasplat as osp
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.gaussians.frames import frames_from_normals, quaternions_from_matrices
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.spherical_harmonics import fibonacci_sphere
from octasplat.engine.render.environment_files import write_environment
from tests.support.small_run import RUN_OPTIONS

COUNT = 1200


def small_scene() -> FlatGaussians:
    """A ball of radius 1, whose colors say where the surface faces."""
    normals = fibonacci_sphere(COUNT).astype(np.float32)
    random = np.random.default_rng(4)
    sh = np.zeros((COUNT, 4, 3), np.float32)
    sh[:, 0] = normals
    sh[:, 1:] = 0.1 * random.standard_normal((COUNT, 3, 3))
    return FlatGaussians(
        means_world=normals.copy(),
        quats_wxyz=quaternions_from_matrices(frames_from_normals(normals)),
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


@pytest.fixture(scope="session")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of nine small photographs with their poses."""
    folder = tmp_path_factory.mktemp("photographs") / "photos"
    config = SyntheticDatasetConfig(views=9, width_px=48, height_px=36, samples_per_side=1, points=300)
    write_synthetic_dataset(folder, config)
    return folder


@pytest.fixture(scope="session")
def finished_run(photographs: Path) -> Path:
    """A run on the photographs that was soon over."""
    folder = photographs.parent / "run"
    osp.reconstruct(photographs, folder, **RUN_OPTIONS)
    return folder


@pytest.fixture
def in_folder(scene_file: Path, photographs: Path, finished_run: Path) -> Iterator[Path]:
    """A folder with ``scene.ply``, ``shiny.ply``, ``photos`` and ``run``, as the current one."""
    folder = scene_file.parent
    half = np.zeros((COUNT, 1), np.float32)
    half[::2] = 1
    shiny = small_scene().with_channels(
        {"albedo": np.full((COUNT, 3), 0.5, np.float32), "metallic": half, "roughness": 0.5 - 0.2 * half}
    )
    write_gaussian_ply(shiny, folder / "shiny.ply")
    for name, height in (("cage", 2.0), ("bent", 2.5)):
        corners = [(x, y, z * height) for x in (-2, 2) for y in (-2, 2) for z in (-1, 1)]
        faces = ("1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4")
        lines = [*("v {} {} {}".format(*corner) for corner in corners), *(f"f {face}" for face in faces)]
        (folder / f"{name}.obj").write_text("\n".join(lines) + "\n")
    write_environment(folder / "studio.hdr", np.ones((16, 32, 3), np.float32))
    shutil.copytree(photographs, folder / "photos")
    shutil.copytree(finished_run, folder / "run")
    before = Path.cwd()
    os.chdir(scene_file.parent)
    yield scene_file.parent
    os.chdir(before)
