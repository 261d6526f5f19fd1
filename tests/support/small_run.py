"""Options of a reconstruction that takes seconds."""

from typing import Any

RUN_OPTIONS: dict[str, Any] = {
    "preset": "fast",
    "iterations": 60,
    "rays_per_batch": 512,
    "sh_degree": 0,
    "max_gaussians": 300,
    "train": {"initial_points": 300},
    "exports": ["mesh.ply"],
}
