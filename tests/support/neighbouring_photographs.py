"""Photographs from neighbouring places on the lowest ring of the generated scene, and no others."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig
from octasplat.engine.dataset.synthetic.files import write_photograph
from octasplat.engine.dataset.synthetic.photograph_renderer import PhotographRenderer
from octasplat.engine.dataset.synthetic.synthetic_views import synthetic_camera, synthetic_views
from octasplat.engine.dataset.synthetic.write import cached_lit_scene


def write_neighbours(folder: Path, count: int) -> dict[str, Float64[np.ndarray, "3"]]:
    """Take the first ``count`` of 40 photographs, which is enough for COLMAP; returns where from, by name."""
    config = SyntheticDatasetConfig(views=40, width_px=480, height_px=360, samples_per_side=1)
    camera = synthetic_camera(config)
    photographer = PhotographRenderer(cached_lit_scene(config.scene, config.houses), camera, config)
    folder.mkdir(parents=True)
    taken = synthetic_views(config)[:count]
    for view in taken:
        write_photograph(folder / view.name, photographer.render(view).pixels)
    return {view.name: view.centre_world for view in taken}
