"""The least size of Gaussians: what no photograph can show is not to be learnt.

After the 3D smoothing filter of "Mip-Splatting: Alias-free 3D Gaussian Splatting"
(https://arxiv.org/abs/2311.16493), as a floor instead of a convolution.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from octasplat.engine.gaussians.model import FlatGaussians


@dataclass(frozen=True, eq=False)
class MinScale:
    """No standard deviation is smaller than so much of a pixel of the nearest training camera.

    Attributes:
        origins_world: where the training cameras stand.
        angle_rad: the least standard deviation as seen from there.
    """

    origins_world: Float64[np.ndarray, "c 3"]
    angle_rad: float

    def apply(self, gaussians: FlatGaussians) -> None:
        """Raise the scales that are smaller, in place."""
        away = cKDTree(self.origins_world).query(gaussians.means_world)[0]
        floor = np.log(np.maximum(self.angle_rad * away, 1e-12)).astype(np.float32)
        np.maximum(gaussians.log_scales, floor[:, None], out=gaussians.log_scales)
