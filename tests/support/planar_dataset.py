"""A painted plane and a few cameras in front of it: the smallest data that can be trained on."""

from pathlib import Path

import numpy as np

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.dataset import DatasetView
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.train.config import McmcConfig, TrainConfig
from octasplat.engine.train.initialization.initial_gaussians import gaussians_from_points
from octasplat.engine.train.sampling.batches import BatchOptions, BatchSource
from octasplat.engine.train.sampling.pixel_sampler import TrainingData

EXTENT = 1.0


def plane_texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Color of the plane z = 0 at a point, in [0.1, 0.9]."""
    waves = np.stack([np.sin(4 * x), np.sin(4 * y + 1), np.sin(3 * x - 2 * y)], axis=-1)
    return (0.5 + 0.4 * waves).astype(np.float32)


class PlanarDataset:
    """Pinhole cameras in the plane z = -2 that look straight at the painted plane; follows TrainingData."""

    detail = 1.0
    """Waves are so many times as short."""

    def __init__(self, count: int = 7, side_px: int = 40, held_out: int = 1) -> None:
        rng = np.random.default_rng(0)
        self.origins = np.concatenate([rng.uniform(-0.5, 0.5, (count, 2)), np.full((count, 1), -2.0)], axis=1)
        self.side_px = side_px
        self.views = tuple(
            DatasetView(f"{k}.png", 0, np.eye(3), -origin, side_px, side_px, Path(f"{k}.png"), None)
            for k, origin in enumerate(self.origins)
        )
        self.train_indices = np.arange(held_out, count)
        self.test_indices = np.arange(held_out)
        self.has_alpha = False
        self.extent = EXTENT
        self.poison = False

    def rays(self, view: np.ndarray, y: np.ndarray, x: np.ndarray) -> RayBatch:
        half = self.side_px / 2
        directions = np.stack(
            [(x + 0.5 - half) / half, (y + 0.5 - half) / half, np.full(len(x), 2.0)], axis=-1
        )
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        return RayBatch(self.origins[view], directions)

    def pixels(
        self, view: np.ndarray, y: np.ndarray, x: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.shown(self.rays(view, y, x))

    def shown(self, rays: RayBatch) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Color, alpha and weight of the plane where rays meet it."""
        origins, directions = rays.origins_world, rays.directions_world
        points = origins - directions * (origins[:, 2:] / directions[:, 2:])
        rgb = plane_texture(self.detail * points[:, 0], self.detail * points[:, 1])
        if self.poison:
            rgb[:] = np.nan
        ones = np.ones(len(rays), np.float32)
        return rgb, ones, ones.copy()

    def initial_gaussians(
        self, count: int = 300, opacity: float = 0.1, *, painted: bool = False
    ) -> FlatGaussians:
        """Gaussians on random points of the plane, grey or in its colors."""
        rng = np.random.default_rng(1)
        xyz = np.concatenate([rng.uniform(-1.6, 1.6, (count, 2)), np.zeros((count, 1))], axis=1)
        painting = plane_texture(self.detail * xyz[:, 0], self.detail * xyz[:, 1])
        return gaussians_from_points(
            xyz.astype(np.float32),
            painting if painted else np.full((count, 3), 0.5, np.float32),
            self.origins,
            extent=self.extent,
            limit=count,
            opacity=opacity,
            rng=rng,
        )


def random_gaussians(count: int, seed: int, degree: int = 0) -> FlatGaussians:
    """Gaussians whose every parameter is drawn from a normal distribution."""
    rng = np.random.default_rng(seed)
    shapes = {
        "means_world": (3,),
        "quats_wxyz": (4,),
        "log_scales": (2,),
        "opacity_logits": (),
        "sh": ((degree + 1) ** 2, 3),
    }
    return FlatGaussians(**{k: rng.normal(size=(count, *s)).astype(np.float32) for k, s in shapes.items()})


def batch_source(dataset: TrainingData, config: TrainConfig) -> BatchSource:
    """Return the batches of a training with these settings."""
    return BatchSource(dataset, BatchOptions.from_config(config, dataset))


def small_config(**changes: object) -> TrainConfig:
    """A run of seconds in which everything happens: growth, a higher degree, checkpoints."""
    values: dict[str, object] = {
        "iterations": 120,
        "rays_per_batch": 1024,
        "ssim_patch_fraction": 0.5,
        "ssim_patch_side": 16,
        "sh_degree": 1,
        "sh_degree_interval": 60,
        "max_gaussians": 400,
        "densify_from_iter": 10,
        "densify": McmcConfig(start=20, interval=20, growth=0.1),
        "rebuild_every": 10,
        "checkpoint_every": 20,
        "probe_rays": 512,
    }
    return TrainConfig.model_validate({**TrainConfig().model_dump(), **values, **changes})
