"""The pictures of the report: which views to keep, the colors of an error map, images as data URIs."""

import base64
import bisect
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from octasplat.engine.render.image_files import shrink_to, write_webp

WORST_COUNT = 12
BEST_COUNT = 4
MAX_SIDE_PX = 800
WEBP_QUALITY = 85

MAGMA = np.array(
    [
        [0.001, 0.000, 0.014], [0.039, 0.031, 0.133], [0.112, 0.065, 0.276], [0.210, 0.062, 0.417],
        [0.315, 0.071, 0.485], [0.413, 0.110, 0.504], [0.511, 0.147, 0.508], [0.611, 0.181, 0.499],
        [0.713, 0.214, 0.476], [0.814, 0.254, 0.438], [0.901, 0.316, 0.390], [0.959, 0.414, 0.360],
        [0.986, 0.530, 0.380], [0.996, 0.648, 0.442], [0.997, 0.763, 0.530], [0.993, 0.878, 0.634],
        [0.987, 0.991, 0.750],
    ],
    dtype=np.float32,
)  # fmt: skip
"""The colors FLIP maps are shown in, at 17 equal steps of the error from 0 to 1."""


@dataclass(frozen=True)
class ViewImages:
    """Images of one view for the report: display values, the FLIP error per pixel, and layers by name."""

    photograph: Float32[np.ndarray, "h w 3"]
    render: Float32[np.ndarray, "h w 3"]
    flip_map: Float32[np.ndarray, "h w"]
    layers: Mapping[str, Float32[np.ndarray, "h w 3"]] = field(default_factory=dict)

    def downscale(self, max_side_px: int = MAX_SIDE_PX) -> "ViewImages":
        """Return the images downscaled to at most ``max_side_px`` in width and height."""
        return ViewImages(
            shrink_to(self.photograph, max_side_px),
            shrink_to(self.render, max_side_px),
            shrink_to(self.flip_map[..., None], max_side_px)[..., 0],
            {name: shrink_to(image, max_side_px) for name, image in self.layers.items()},
        )


class WorstAndBestViews(Mapping[str, ViewImages]):
    """Keeps the images of the views that the report embeds, shrunk, while views pass by one by one."""

    def __init__(self, worst: int = WORST_COUNT, best: int = BEST_COUNT) -> None:
        """Keep ``worst`` views of the lowest and ``best`` of the highest PSNR."""
        self._worst, self._best = worst, best
        self._order: list[tuple[float, str]] = []
        self._images: dict[str, ViewImages] = {}

    def offer(self, name: str, psnr: float, images: ViewImages) -> None:
        """Keep the images of ``name`` for as long as it is among the worst or the best."""
        # An undefined PSNR (no valid pixel) says nothing; it sorts last, as in the report's table.
        entry = (float("inf") if np.isnan(psnr) else psnr, name)
        place = bisect.bisect(self._order, entry)
        full = len(self._order) == self._worst + self._best
        # Between the worst and the best ones, among which it is neither
        if full and place == self._worst:
            return
        self._order.insert(place, entry)
        self._images[name] = images.downscale()
        if full:
            _, dropped = self._order.pop(self._worst)
            del self._images[dropped]

    def __getitem__(self, name: str) -> ViewImages:
        return self._images[name]

    def __iter__(self) -> Iterator[str]:
        return (name for _, name in self._order)

    def __len__(self) -> int:
        return len(self._order)


def embedded_names(worst_first: list[str], images: Mapping[str, ViewImages]) -> list[str]:
    """Return the views to embed: all that have images, or the 12 worst and 4 best if there are more."""
    known = [name for name in worst_first if name in images]
    return known if len(known) <= WORST_COUNT + BEST_COUNT else [*known[:WORST_COUNT], *known[-BEST_COUNT:]]


def magma(values: Float32[np.ndarray, "*shape"]) -> Float32[np.ndarray, "*shape 3"]:
    """Return colors of errors in [0, 1], from black over purple and orange to pale yellow."""
    steps = np.linspace(0, 1, len(MAGMA))
    return np.stack([np.interp(values, steps, MAGMA[:, k]) for k in range(3)], axis=-1).astype(np.float32)


def webp_data_uri(image: Float32[np.ndarray, "h w 3"]) -> str:
    """Return the image as a WebP data URI, for a page without other files."""
    # write_webp() writes to files only.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "image.webp"
        write_webp(path, image, quality=WEBP_QUALITY)
        return "data:image/webp;base64," + base64.b64encode(path.read_bytes()).decode("ascii")
