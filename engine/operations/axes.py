"""Axes of the world by name, such as ``-y``. Imports numpy when it is needed only."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float64

Axis = Literal["x", "-x", "y", "-y", "z", "-z"]


def axis_named(name: str) -> "Float64[np.ndarray, '3']":
    """Return the unit vector of ``x``, ``-x``, ``y`` and so on."""
    import numpy as np

    axis = np.eye(3)["xyz".index(name[-1])]
    return -axis if name.startswith("-") else axis


def light_up(source: Path, name: str | None) -> "Float64[np.ndarray, '3']":
    """Return the up direction, world frame, for the light on a scene with materials.

    Args:
        source: folder of a run, or a file of Gaussians.
        name: the axis that the user says; None for that of the run, or -y.

    Raises:
        ConfigError: the run's settings cannot be read.
    """
    import numpy as np

    from octasplat.engine.runs.config import read_config
    from octasplat.engine.runs.run_folder import CONFIG, is_run

    if name is None and is_run(source) and (source / CONFIG).exists():
        return np.array(read_config(source / CONFIG).train.materials.up_world, np.float64)
    return axis_named(name or "-y")  # up in most worlds that COLMAP makes
