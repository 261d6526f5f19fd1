"""The file of the residual colors that a run has learnt, beside its scene."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.writing import atomic_replace
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.runs.run_folder import RESIDUAL
from octasplat.engine.train.loop.checkpoint import ARCHIVE_DAMAGE

COEFFICIENT_COUNTS = (1, 4, 9, 16)
"""Coefficients of harmonics of degree 0 to 3."""


def write_residual(output: Path, residual_sh: Float32[np.ndarray, "n k 3"]) -> None:
    """Write the harmonics of the residual color of each Gaussian of a run, atomically."""
    with atomic_replace(output / RESIDUAL) as temporary:
        np.savez(temporary, sh=residual_sh)


def read_residual(output: Path, gaussians: FlatGaussians) -> Float32[np.ndarray, "n k 3"] | None:
    """Return the harmonics of the residual color of each Gaussian of a run; None where it has none.

    Args:
        output: folder of the run.
        gaussians: its scene.

    Raises:
        ConfigError: the file is damaged, or of another scene.
    """
    path = output / RESIDUAL
    if not path.exists():
        return None
    try:
        # an open file by itself, as numpy leaves that of a damaged one open
        with path.open("rb") as handle, np.load(handle, allow_pickle=False) as arrays:
            found = arrays["sh"]
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
    if not is_harmonics or len(found) != len(gaussians) or not np.isfinite(found).all():
        raise ConfigError(
            f"{path} does not belong to the scene beside it; delete it to show the run without residual "
            "colors."
        )
    return np.ascontiguousarray(found)  # kernels take rows one after the other
