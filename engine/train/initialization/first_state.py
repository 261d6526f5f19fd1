"""The state before the first iteration, made from the photographs."""

from octasplat.engine.dataset import Dataset
from octasplat.engine.train.config import TrainConfig
from octasplat.engine.train.initialization.initial_background import first_background
from octasplat.engine.train.initialization.initial_gaussians import initial_gaussians, with_first_materials
from octasplat.engine.train.loop.state import TrainState, fresh_state
from octasplat.engine.train.shading_factory import background_of, make_shading


def first_state(dataset: Dataset, config: TrainConfig, *, threads: int = 1) -> TrainState:
    """The first Gaussians, their materials and the first background, as far as these are learnt.

    Args:
        dataset: the photographs.
        config: all knobs.
        threads: work side by side, which changes nothing that is made.

    Raises:
        DatasetError: nothing says where Gaussians could begin.
    """
    behind = first_background(dataset) if config.background == "learnt" else None
    first = initial_gaussians(dataset, config, threads=threads, behind=behind)
    if config.materials.learn:
        first = with_first_materials(first, config.materials)
    state = fresh_state(first, config.seed)
    shading = make_shading(config, len(dataset.views), dataset.extent)
    background = background_of(shading)
    if behind is not None and background is not None:
        background.put(behind.enlarged(config.background_height))
        state.shading = shading.state()
    return state
