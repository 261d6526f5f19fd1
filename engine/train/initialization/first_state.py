"""The state before the first iteration, made from the photographs."""

from octasplat.engine.dataset import Dataset
from octasplat.engine.train.config import TrainConfig
from octasplat.engine.train.initialization.initial_background import estimate_background
from octasplat.engine.train.initialization.initial_gaussians import (
    InitialGaussianOptions,
    add_initial_materials,
    initial_gaussians,
)
from octasplat.engine.train.loop.state import TrainState, initial_state
from octasplat.engine.train.shading_factory import ShadingOptions, find_background, make_shading


def initial_scene(dataset: Dataset, config: TrainConfig, *, threads: int = 1) -> TrainState:
    """The first Gaussians, their materials and the first background, as far as these are learnt.

    Args:
        dataset: the photographs.
        config: all knobs.
        threads: work side by side, which changes nothing that is made.

    Raises:
        DatasetError: nothing says where Gaussians could begin.
    """
    behind = estimate_background(dataset) if config.background == "learnt" else None
    options = InitialGaussianOptions.from_config(config, dataset)
    first = initial_gaussians(dataset, options, threads=threads, background=behind)
    if config.materials.learn:
        first = add_initial_materials(first, config.materials)
    state = initial_state(first, config.seed)
    shading = make_shading(ShadingOptions.from_config(config), len(dataset.views), dataset.extent)
    background = find_background(shading)
    if behind is not None and background is not None:
        background.set_map(behind.resize(config.background_height))
        state.shading = shading.state()
    return state
