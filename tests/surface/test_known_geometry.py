"""The generated scene, whose geometry is known: from its true depth, and from a reconstruction of it."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.dataset import DatasetModel, load_dataset_model
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.dataset.synthetic.still_life import TABLE_RADIUS, build_still_life
from octasplat.engine.evaluate.surface_metrics import (
    SurfaceMetrics,
    distances_to_surface,
    sample_surface,
    surface_metrics,
)
from octasplat.engine.files.gaussian_ply import read_gaussian_ply
from octasplat.engine.geometry.triangle_mesh import TriangleMesh, edge_report
from octasplat.engine.pipeline import reconstruct
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.engine.runs.config import resolve_config
from octasplat.engine.runs.run_folder import SCENE
from octasplat.engine.surface.depth_cameras import photograph_cameras
from octasplat.engine.surface.depth_maps import DepthMaps
from octasplat.engine.surface.extract import extract_levels
from octasplat.engine.surface.marching_cubes import marching_cubes
from octasplat.engine.surface.occlusion import Occluder
from octasplat.engine.surface.options import ExtractionOptions
from octasplat.engine.surface.region import choose_region
from octasplat.engine.surface.tsdf_volume import fuse_depth_maps
from octasplat.engine.trace.cpu.tracer import CpuTracer
from tests.support.image_channels import read_channels

MIN_VIEWS = 3
"""Only what so many cameras see can be asked for."""


def on_the_table(mesh: TriangleMesh) -> TriangleMesh:
    """The triangles of the table's top and of what stands on it."""
    corners = mesh.face_corners_world
    near = np.linalg.norm(corners[..., :2], axis=-1).max(axis=1) < TABLE_RADIUS + 0.05
    return mesh.select_faces(near & (corners[..., 2].min(axis=1) > -0.07))


def scored(mesh: TriangleMesh, cameras: tuple[PinholeCamera, ...], threshold: float) -> SurfaceMetrics:
    """How near the things on the table come to the truth."""
    rng = np.random.default_rng(0)
    life = build_still_life()
    truth = TriangleMesh(life.vertices, life.faces)
    wanted, _ = sample_surface(on_the_table(truth), 20_000, rng)
    occluder = Occluder(truth)
    views = np.zeros(len(wanted), int)
    for camera in cameras:
        views += occluder.is_visible(wanted, np.broadcast_to(camera.centre_world, wanted.shape))
    found = on_the_table(mesh)
    there, _ = sample_surface(found, 20_000, rng)
    return surface_metrics(
        distances_to_surface(there, truth, rng, 500_000),
        distances_to_surface(wanted[views >= MIN_VIEWS], found, rng, 300_000),
        threshold,
    )


def scene_and_cameras(root: Path, **size: int) -> tuple[DatasetModel, tuple[PinholeCamera, ...]]:
    write_synthetic_dataset(root, SyntheticDatasetConfig(**size))
    scene = load_dataset_model(root)
    return scene, photograph_cameras(scene, np.arange(len(scene.views)), 800)


@pytest.mark.exhaustive
def test_true_depth_gives_the_true_surface(tmp_path):
    scene, cameras = scene_and_cameras(
        tmp_path / "scene", views=30, width_px=240, height_px=180, samples_per_side=1, points=100
    )
    distances, cosines = [], []
    for view, camera in zip(scene.views, cameras, strict=True):
        truth = tmp_path / "scene" / "ground_truth"
        name = Path(view.name).with_suffix(".exr").name
        depth_cam = read_channels(truth / "depth" / name)["Z"]
        layers = read_channels(truth / "normals" / name)
        normals = np.stack([layers[f"N.{axis}"] for axis in "xyz"], axis=-1)
        directions = camera.rays().directions_world
        along = directions @ camera.rotation_cam_from_world[2]
        distances.append((depth_cam / along).astype(np.float32))
        cosines.append(np.abs((normals * directions).sum(axis=-1)).astype(np.float32))
    options = ExtractionOptions(resolution=320)
    maps = DepthMaps(cameras, tuple(distances), tuple(cosines))
    mesh = marching_cubes(fuse_depth_maps(maps, choose_region(maps, options), options), options.min_weight)
    result = scored(mesh, cameras, 0.01)
    assert result.chamfer < 0.004
    assert result.f_score > 0.93
    report = edge_report(mesh.faces)
    assert report.non_manifold_edges == report.inconsistent_edges == 0


@pytest.mark.exhaustive
@pytest.mark.heavy
def test_reconstruction_comes_near_the_truth(tmp_path):
    _, cameras = scene_and_cameras(
        tmp_path / "scene", views=24, width_px=160, height_px=120, samples_per_side=2, points=4000
    )
    config = resolve_config(
        "fast",
        settings={"test_every": 0, "exports": ()},
        assignments=["iterations=700", "rays_per_batch=4096", "max_gaussians=12000", "initial_points=4000"],
    )
    run = reconstruct(tmp_path / "scene", tmp_path / "run", config)
    gaussians, _ = read_gaussian_ply(run / SCENE)
    tracer = CpuTracer()
    tracer.build(gaussians)
    options = ExtractionOptions(resolution=256)
    median, expected = (
        extract_levels(tracer, cameras, options.model_copy(update={"depth_mode": depth}), scratch=tmp_path)[
            0
        ].mesh
        for depth in ("median", "expected")
    )
    result = scored(median, cameras, 0.02)
    assert result.f_score > 0.8
    assert result.chamfer < 0.015
    # The measurement behind the default.
    assert result.f_score > scored(expected, cameras, 0.02).f_score
