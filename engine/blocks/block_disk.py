"""Disk that the training of a block takes in the folder of its run, where it is the only one there."""

from collections.abc import Mapping

from octasplat.engine.blocks.block_photographs import BlockPhotographs
from octasplat.engine.blocks.scene_plan import ScenePlan
from octasplat.engine.dataset import Viewpoints
from octasplat.engine.dataset.ray_tables import MAX_TABLE_BYTES
from octasplat.engine.gaussians.merge import with_sh_degree
from octasplat.engine.gaussians.rows import row_arrays
from octasplat.engine.train.config import TrainConfig, max_gaussian_count
from octasplat.engine.train.loop.checkpoint import KEPT_CHECKPOINTS, BestState

_RAY_BYTES = 12
"""For a pixel of the table of directions of a camera with distortion."""
_DEPTH_BYTES = 4
_STATES = 4
"""Numbers of a checkpoint for each parameter of a Gaussian: itself, two moments and its mean."""
_DENSIFIER_BYTES = 32
"""For a Gaussian, in a checkpoint: what decides where others are added."""
_OTHER_BYTES = 4 << 20
_OTHER_BYTES_PER_VIEW = 4096
"""For logs, records and what is shown of the scene meanwhile."""


def block_disk_bytes(
    plan: ScenePlan,
    number: int,
    photographs: BlockPhotographs,
    views: Viewpoints,
    config: TrainConfig,
    coarse: BestState,
) -> int:
    """Return how many bytes the training of a block adds to what it begins with, at most.

    The photographs that it needs are decoded; they themselves lie elsewhere. Beside the newest checkpoints
    there may be one that is being written, or in the end the result, which is smaller.

    Args:
        plan: of the scene.
        number: of the block, from 1.
        photographs: what each block needs of them.
        views: of the run, at the size that it trains on.
        config: of the block's training, see :func:`octasplat.engine.blocks.piece_settings.block_settings`.
        coarse: what it begins with.
    """
    block, facts = plan.blocks[number - 1], photographs.facts
    shown = photographs.views[number - 1]
    sizes = [views.views[index].width_px * views.views[index].height_px for index in shown]
    planes = 3 * max(info.bits for info in facts.infos) // 8
    planes += facts.has_alpha + any(mask is not None for _, mask, _ in facts.files)
    decoded = planes * sum(sizes)
    if facts.depth_units_world is not None:
        # maps are of the size of their photographs as a rule, those of known geometry of that of the views
        full = (facts.infos[index].width_px * facts.infos[index].height_px for index in shown)
        decoded += _DEPTH_BYTES * sum(map(max, full, sizes))
    bent = [camera for camera in views.cameras if not camera.is_pinhole]
    tables = sum(_RAY_BYTES * camera.width_px * camera.height_px for camera in bent)
    begun = int(block.trained.contains(coarse.gaussians.means_world).sum())
    count = max(begun, max_gaussian_count(config, block.pixels.drawn_pixel_count))
    one = with_sh_degree(coarse.gaussians.select(slice(0, 1)), config.sh_degree)
    each = _bytes_of(row_arrays(one))
    shading = _bytes_of(coarse.shading)
    checkpoints = (KEPT_CHECKPOINTS + 1) * ((_STATES * each + _DENSIFIER_BYTES) * count + shading)
    other = _OTHER_BYTES + _OTHER_BYTES_PER_VIEW * len(views.views)
    return decoded + min(tables, MAX_TABLE_BYTES) + checkpoints + other


def _bytes_of(arrays: Mapping[str, object]) -> int:
    return sum(int(getattr(array, "nbytes", 0)) for array in arrays.values())
