"""Photographs from neighbouring places on the lowest ring of the generated scene, and no others."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from octasplat.engine.scene.generated import GeneratedSceneConfig
from octasplat.engine.scene.generated.cameras import lens, views
from octasplat.engine.scene.generated.dataset import lit_scene
from octasplat.engine.scene.generated.files import write_photograph
from octasplat.engine.scene.generated.photographs import Photographer


def write_neighbours(folder: Path, count: int) -> dict[str, Float64[np.ndarray, "3"]]:
    """Take the first ``count`` of 40 photographs, which is enough for COLMAP; returns where from, by name."""
    config = GeneratedSceneConfig(views=40, width_px=480, height_px=360, samples_per_side=1)
    camera = lens(config)
    photographer = Photographer(lit_scene(), camera, config)
    folder.mkdir(parents=True)
    taken = views(config)[:count]
    for view in taken:
        write_photograph(folder / view.name, photographer.take(view).pixels)
    return {view.name: view.centre_world for view in taken}
