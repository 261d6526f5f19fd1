"""The state of a training: everything that the rest of a run depends on, and the least size of Gaussians."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64, Int64

from octasplat.engine.dataset.model import Viewpoints
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.shots import training_pixel_angle
from octasplat.engine.train.optimization.adam import Adam
from octasplat.engine.train.optimization.weight_averaging import WeightAverage


@dataclass
class TrainState:
    """The state before iteration ``iteration`` (0 at the start).

    Attributes:
        iteration: iterations done.
        gaussians: parameters.
        adam: optimiser state.
        rng: the generator that draws batches and everything else that is random.
        densifier: what the densification strategy has observed, as of the last checkpoint.
        shading: parameters and optimiser state of the shading model, as of the last checkpoint.
        seconds: training time so far, with the making of the first Gaussians, without measuring.
        running_mse: smoothed squared error of the training rays.
        best_psnr: best probe so far, dB; the Gaussians that reached it are in ``best.npz``.
        best_iteration: when that was.
        excluded_views: training views that are left out from here on.
        average: the mean of the last states, where they are averaged.
        pose_corrections: of all views, where poses are refined: the rotation vectors (rad) and shifts (world
            units) by which the points of their cameras move.
        probes: iterations and training rays' probe after them, dB.
        early_stop_at: where it was decided to end early, None where it was not.
        pruned_near_cameras: Gaussians taken away so far for being too near to a camera.
    """

    iteration: int
    gaussians: FlatGaussians
    adam: Adam
    rng: np.random.Generator
    densifier: dict[str, np.ndarray] = field(default_factory=dict)
    shading: dict[str, np.ndarray] = field(default_factory=dict)
    seconds: float = 0.0
    running_mse: float = 0.0
    best_psnr: float = -np.inf
    best_iteration: int = 0
    excluded_views: Int64[np.ndarray, " m"] = field(default_factory=lambda: np.zeros(0, np.int64))
    probes: list[tuple[int, float]] = field(default_factory=list)
    early_stop_at: int | None = None
    pruned_near_cameras: int = 0
    pose_corrections: Float64[np.ndarray, "v 6"] = field(default_factory=lambda: np.zeros((0, 6)))
    average: WeightAverage = field(default_factory=WeightAverage)

    def raise_sh_degree(self, degree: int) -> None:
        """Give the colors harmonics up to ``degree``, zero at first, if they have less."""
        if degree > self.gaussians.sh_degree:
            count = (degree + 1) ** 2
            extra = count - self.gaussians.sh.shape[1]
            self.gaussians.sh = np.pad(self.gaussians.sh, ((0, 0), (0, extra), (0, 0)))
            self.adam = self.adam.with_sh_basis(count)


def initial_state(gaussians: FlatGaussians, seed: int) -> TrainState:
    """Return the state before the first iteration."""
    return TrainState(
        iteration=0,
        gaussians=gaussians,
        adam=Adam.zeros(gaussians),
        rng=np.random.Generator(np.random.PCG64([seed, 0])),
    )


@dataclass(frozen=True, eq=False)
class MinScale:
    """The least size of Gaussians: what no photograph can show is not to be learnt.

    After the 3D smoothing filter of "Mip-Splatting: Alias-free 3D Gaussian Splatting"
    (https://arxiv.org/abs/2311.16493), as a lower limit instead of a convolution.

    Attributes:
        origins_world: where the training cameras stand.
        angle_rad: least standard deviation as seen from the nearest of them.
    """

    origins_world: Float64[np.ndarray, "c 3"]
    angle_rad: float

    @classmethod
    def of_views(
        cls, viewpoints: Viewpoints, train_indices: Int64[np.ndarray, " t"], min_scale_px: float
    ) -> "MinScale | None":
        """Return the least size of so many pixels of the nearest training view; None where that is 0."""
        if min_scale_px == 0:
            return None
        pixel_rad = training_pixel_angle(viewpoints)
        origins = np.stack([viewpoints.views[i].origin_world for i in train_indices.tolist()])
        return cls(origins, min_scale_px * pixel_rad)

    def apply(self, gaussians: FlatGaussians) -> None:
        """Raise the scales that are smaller, in place."""
        from scipy.spatial import cKDTree  # here, as every render imports this module

        # the nearest camera shows the finest detail
        distance = cKDTree(self.origins_world).query(gaussians.means_world)[0]
        least = np.log(np.maximum(self.angle_rad * distance, 1e-12)).astype(np.float32)
        np.maximum(gaussians.log_scales, least[:, None], out=gaussians.log_scales)
