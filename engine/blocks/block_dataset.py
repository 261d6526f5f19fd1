"""The photographs of a run as one block sees them: some of the pixels of some of the views."""

import numpy as np
from jaxtyping import Float32, Int64

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.dataset import Dataset, DatasetView
from octasplat.engine.dataset.view_tiles import Rectangles


class BlockDataset:
    """Pixels of a dataset that train a block.

    Follows :class:`octasplat.engine.train.sampling.pixel_sampler.PartialTrainingData`. Views keep their
    numbers; none is held out, since those are measured on the merged scene.

    Args:
        dataset: the photographs.
        trained_pixels: those to train on.
    """

    def __init__(self, dataset: Dataset, trained_pixels: Rectangles) -> None:
        self._dataset = dataset
        self.trained_pixels: Rectangles | None = trained_pixels
        self.views: tuple[DatasetView, ...] = dataset.views
        self.train_indices: Int64[np.ndarray, " t"] = np.unique(trained_pixels.view)
        self.test_indices: Int64[np.ndarray, " h"] = np.zeros(0, np.int64)
        self.has_alpha: bool = dataset.has_alpha
        self.extent: float = dataset.extent
        self.has_known_distances: bool = dataset.has_known_distances

    def rays(
        self, view: Int64[np.ndarray, " r"], y: Int64[np.ndarray, " r"], x: Int64[np.ndarray, " r"]
    ) -> RayBatch:
        """Return unit rays of pixels, world frame."""
        return self._dataset.rays(view, y, x)

    def pixels(
        self, view: Int64[np.ndarray, " r"], y: Int64[np.ndarray, " r"], x: Int64[np.ndarray, " r"]
    ) -> tuple[Float32[np.ndarray, "r 3"], Float32[np.ndarray, " r"], Float32[np.ndarray, " r"]]:
        """Return straight display color, alpha and weight of pixels."""
        return self._dataset.pixels(view, y, x)

    def known_distances(
        self, view: Int64[np.ndarray, " r"], y: Int64[np.ndarray, " r"], x: Int64[np.ndarray, " r"]
    ) -> Float32[np.ndarray, " r"]:
        """Return distances of the surface along the rays of pixels, world units; 0 where unknown."""
        return self._dataset.known_distances(view, y, x)
