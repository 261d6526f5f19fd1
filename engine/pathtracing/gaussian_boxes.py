"""Boxes around Gaussians, for rays that pass all of them."""

import numpy as np
from jaxtyping import Float32

from octasplat.engine.gaussians.frames import rotation_matrices
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.morton import morton_order

MAX_BOXES = 32
_MARGIN = 1e-5
"""By which boxes are larger, of their farthest coordinate: more than float32 loses of it."""


def bounding_boxes(gaussians: FlatGaussians, q: float) -> Float32[np.ndarray, "6 b"]:
    """Return boxes that hold all octagons of Gaussians, at most ``MAX_BOXES``, a column each.

    A column is the least corner and the greatest corner. Each box holds Gaussians that follow each other
    along a Z-order curve.

    Args:
        gaussians: of any number.
        q: squared radius of an opaque octagon in standard deviations.

    >>> from octasplat.engine.gaussians.model import FlatGaussians
    >>> one = FlatGaussians(*(np.zeros((1, *rest), np.float32) for rest in [(3,), (4,), (2,), (), (1, 3)]))
    >>> one.quats_wxyz[0, 0] = 1.0
    >>> bounding_boxes(one, 9.0).round(3).T.tolist()  # standard deviations of 1 along y and z
    [[-0.0, -3.0, -3.0, 0.0, 3.0, 3.0]]
    """
    if len(gaussians) == 0:
        return np.zeros((6, 0), np.float32)
    boxes = []
    for part in np.array_split(morton_order(gaussians.means_world), min(MAX_BOXES, len(gaussians))):
        # a part at a time, as the rotations of all take gigabytes
        means = gaussians.means_world[part].astype(np.float64)
        scales = np.exp(gaussians.log_scales[part]).astype(np.float64)
        legs = rotation_matrices(gaussians.quats_wxyz[part])[:, :, 1:] * scales[:, None, :]
        # the ellipse around the octagon
        half = np.sqrt(q) * np.linalg.norm(legs, axis=2)
        low, high = (means - half).min(axis=0), (means + half).max(axis=0)
        margin = _MARGIN * max(np.abs(low).max(), np.abs(high).max())
        boxes.append(np.concatenate([low - margin, high + margin]))
    return np.stack(boxes, axis=1, dtype=np.float32)
