"""The file of the residual colors that a run has learnt, beside its scene."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32

from octasplat.engine.core.archive_damage import ARCHIVE_DAMAGE
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.writing import atomic_replace
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.runs.run_folder import RESIDUAL

COEFFICIENT_COUNTS = (1, 4, 9, 16)
"""Coefficients of harmonics of degree 0 to 3."""
POSITION_TOLERANCE = np.float32(1e-5)
"""Positions that another program wrote as text are rounded by less than this share of the largest."""


def write_residual(output: Path, gaussians: FlatGaussians, residual_sh: Float32[np.ndarray, "n k 3"]) -> None:
    """Write the harmonics of the residual color of each Gaussian of a run, atomically.

    The positions of the Gaussians go along: they say which scene the rows belong to, and in which order.
    """
    with atomic_replace(output / RESIDUAL) as temporary:
        np.savez(temporary, sh=residual_sh, means=gaussians.means_world)


def read_residual(
    output: Path, gaussians: FlatGaussians, kept: Bool[np.ndarray, " m"] | None = None
) -> Float32[np.ndarray, "n k 3"] | None:
    """Return the harmonics of the residual color of each Gaussian of a run; None where it has none.

    Args:
        output: folder of the run.
        gaussians: its scene.
        kept: which rows of the scene's file ``gaussians`` are; None for all.

    Raises:
        ConfigError: the file is damaged, or of another scene, or the Gaussians were moved or reordered.
    """
    path = output / RESIDUAL
    if not path.exists():
        return None
    try:
        # an open file by itself, as numpy leaves that of a damaged one open
        with path.open("rb") as handle, np.load(handle, allow_pickle=False) as arrays:
            found = arrays["sh"]
            means = arrays.get("means", None)  # which former files have not
    except ARCHIVE_DAMAGE as error:
        raise ConfigError(
            f"{path} cannot be read ({type(error).__name__}); delete it to show the run without residual "
            "colors."
        ) from None
    is_harmonics = (
        found.dtype == np.float32
        and found.ndim == 3
        and found.shape[1] in COEFFICIENT_COUNTS
        and found.shape[2] == 3
    )
    if kept is not None and found.shape[:1] == kept.shape:
        found = found[kept]
        means = means[kept] if means is not None and means.shape[:1] == kept.shape else means
    is_of_scene = is_harmonics and len(found) == len(gaussians) and _is_at(means, gaussians)
    if not is_of_scene or not np.isfinite(found).all():
        raise ConfigError(
            f"{path} does not belong to the scene beside it; delete it to show the run without residual "
            "colors."
        )
    return np.ascontiguousarray(found)  # kernels take rows one after the other


def _is_at(means: np.ndarray | None, gaussians: FlatGaussians) -> bool:
    """Return whether Gaussians are where the file says, row by row, or it says nothing."""
    if means is None:
        return True
    here = gaussians.means_world
    if means.dtype != here.dtype or means.shape != here.shape:
        return False
    return bool((np.abs(means - here) <= POSITION_TOLERANCE * np.abs(here).max(initial=0)).all())
