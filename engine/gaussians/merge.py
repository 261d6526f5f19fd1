"""Several sets of Gaussians as one, with one degree of harmonics and the channels of all."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from octasplat.engine.core.local_origin import Origin
from octasplat.engine.gaussians.channels import merge_widths
from octasplat.engine.gaussians.model import FlatGaussians, concatenate


def about_origin(gaussians: FlatGaussians, origin_world: Origin, new_origin: Origin) -> FlatGaussians:
    """Return a scene with its positions about another local origin."""
    if origin_world == new_origin:
        return gaussians
    shift = np.array(origin_world) - np.array(new_origin)
    return replace(gaussians, means_world=(gaussians.means_world + shift).astype(np.float32))


def with_sh_degree(gaussians: FlatGaussians, degree: int) -> FlatGaussians:
    """Return a copy of the Gaussians with spherical harmonics of another degree.

    Args:
        gaussians: ``n`` Gaussians.
        degree: 0 to 3; missing coefficients are zero, those beyond it are left out.
    """
    count = (degree + 1) ** 2
    own = min(count, gaussians.sh.shape[1])
    result = gaussians.copy()
    result.sh = np.zeros((len(gaussians), count, 3), dtype=np.float32)
    result.sh[:, :own] = gaussians.sh[:, :own]
    return result


def merge_scenes(scenes: Sequence[FlatGaussians], sh_degree: int | None = None) -> FlatGaussians:
    """Return all Gaussians of ``scenes``, in order, with spherical harmonics of one degree.

    The result has the channels of all scenes; Gaussians of a scene without one have 0 there
    (:data:`octasplat.engine.gaussians.channels.FILL_VALUE`).

    Args:
        scenes: at least one.
        sh_degree: of the result; None takes the highest among the scenes, so that nothing is lost.

    Raises:
        ConfigError: two scenes have a channel of one name and different widths.
    """
    degree = max(scene.sh_degree for scene in scenes) if sh_degree is None else sh_degree
    widths = merge_widths(scene.channels for scene in scenes)
    return concatenate(
        [
            replace(with_sh_degree(scene, degree), channels=scene.channels.with_filled(widths, len(scene)))
            for scene in scenes
        ]
    )
