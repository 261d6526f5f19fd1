"""Parts of a scene, and scenes put together."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from engine.errors import ConfigError
from engine.gaussians.channels import common_widths
from engine.gaussians.model import FlatGaussians, concatenate


def inside_box(
    gaussians: FlatGaussians, low_world: Float[np.ndarray, "3"], high_world: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, " n"]:
    """Which centres lie in a box along the world's axes, its sides included.

    Raises:
        ConfigError: some side has a negative length.
    """
    low, high = np.asarray(low_world, np.float64), np.asarray(high_world, np.float64)
    if not (low <= high).all():
        raise ConfigError("A box needs its smallest x, y, z first and then its largest ones.")
    means = gaussians.means_world
    result: np.ndarray = np.logical_and.reduce((means >= low) & (means <= high), axis=1)
    return result


def inside_sphere(
    gaussians: FlatGaussians, centre_world: Float[np.ndarray, "3"], radius_world: float
) -> Bool[np.ndarray, " n"]:
    """Which centres lie in a sphere.

    Raises:
        ConfigError: the radius is not positive.
    """
    if not radius_world > 0.0:
        raise ConfigError("The radius of a sphere must be positive.")
    offsets = gaussians.means_world.astype(np.float64) - np.asarray(centre_world, np.float64)
    result: np.ndarray = np.linalg.norm(offsets, axis=1) <= radius_world
    return result


def with_sh_degree(gaussians: FlatGaussians, degree: int) -> FlatGaussians:
    """The same Gaussians with harmonics of ``degree``: the missing ones zero, those beyond left out."""
    count = (degree + 1) ** 2
    own = min(count, gaussians.sh.shape[1])
    result = gaussians.copy()
    result.sh = np.zeros((len(gaussians), count, 3), dtype=np.float32)
    result.sh[:, :own] = gaussians.sh[:, :own]
    return result


def merge(scenes: Sequence[FlatGaussians], sh_degree: int | None = None) -> FlatGaussians:
    """All Gaussians of ``scenes``, in order, with harmonics of one degree.

    The result has the channels of all scenes; Gaussians of a scene without one have 0 there
    (:data:`engine.gaussians.channels.FILL`).

    Args:
        scenes: at least one.
        sh_degree: of the result; None takes the highest among the scenes, so that nothing is lost.

    Raises:
        ConfigError: two scenes have a channel of one name and different widths.
    """
    degree = max(scene.sh_degree for scene in scenes) if sh_degree is None else sh_degree
    widths = common_widths(scene.channels for scene in scenes)
    return concatenate(
        [
            replace(with_sh_degree(scene, degree), channels=scene.channels.completed(widths, len(scene)))
            for scene in scenes
        ]
    )
