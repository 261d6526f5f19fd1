"""A training of a second that tests watch step by step."""

from octasplat.engine.operations.reconstruct import options_from_json
from octasplat.engine.runs.config import ReconstructionConfig


def watched_config(*, materials: bool = False) -> ReconstructionConfig:
    """Return the settings of 60 iterations on a tiny dataset, growth included."""
    train: dict[str, object] = {
        "iterations": 60, "rays_per_batch": 256, "sh_degree": 1, "max_gaussians": 500, "initial_points": 300,
        "rebuild_every": 20, "checkpoint_every": 1000, "densify_from_iter": 10, "probe_rays": 256,
        "densify": {"interval": 10, "start": 10},
    }  # fmt: skip
    if materials:
        train["materials"] = {"environment_height": 16, "ambient_occlusion_rays": 4}
    options = {"preset": "fast", "train": train, "exports": ["mesh.ply"], "materials": materials}
    return options_from_json(options).config()
