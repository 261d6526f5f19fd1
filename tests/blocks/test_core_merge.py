"""Cores of blocks become one scene in files, block after block, each with what it may have."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.blocks.block_plan import Block
from octasplat.engine.blocks.core_merge import merge_cores
from octasplat.engine.blocks.partition import Box
from octasplat.engine.blocks.scene_plan import ScenePlan, block_name
from octasplat.engine.dataset.view_tiles import Rectangles
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.rows import row_arrays
from octasplat.engine.train.config import TrainConfig
from octasplat.engine.train.loop.checkpoint import BestState, save_best


def gaussians(x: list[float], degree: int) -> FlatGaussians:
    """Some along an axis, whose color says where they are."""
    places = np.array(x, np.float32)
    means = np.zeros((len(x), 3), np.float32)
    means[:, 0] = places
    sh = np.zeros((len(x), (degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = places[:, None]
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (len(x), 1))
    return FlatGaussians(means, quats, np.zeros((len(x), 2), np.float32), np.zeros(len(x), np.float32), sh)


def plan_of_three(views: tuple[int, int, int]) -> ScenePlan:
    """Blocks cut at 0 and 10 along x with a margin of 1, which so many views show."""
    cuts = (-np.inf, 0.0, 10.0, np.inf)

    def box(low: float, high: float) -> Box:
        return Box(np.array([low, -np.inf, -np.inf]), np.array([high, np.inf, np.inf]))

    def pixels(count: int) -> Rectangles:
        return Rectangles(np.arange(count), np.zeros((count, 2), np.int64), np.ones((count, 2), np.int64))

    boxes = [box(low, high) for low, high in pairwise(cuts)]
    blocks = tuple(Block(found, np.ones(3), 0.3, pixels(n)) for found, n in zip(boxes, views, strict=True))
    return ScenePlan(blocks, (1, 1, 1), 1, 1, None, is_finished_together=False)


def merged(folder: Path, most: int) -> tuple[FlatGaussians, list[bool]]:
    """Two blocks that were trained, beside one of which the coarse Gaussians stay."""
    coarse = BestState(gaussians([-5, 3, 4, 20, 5.5], 0), {})
    for number, x in ((1, [0.5, -0.5, -3, -2]), (3, [9, 12, 10.5, 30])):
        (folder / block_name(number)).mkdir()
        save_best(BestState(gaussians(list(x), 1), {}), folder / block_name(number))
    config = TrainConfig(sh_degree=1, max_gaussians=most)
    found, is_near_cut = merge_cores(folder, config, plan_of_three((9, 1, 9)), coarse)
    assert sorted(path.name for path in folder.iterdir()) == ["block_001", "block_003"]
    return found, is_near_cut.tolist()


@pytest.mark.parametrize("most", [0, 9])
def test_cores_follow_each_other(tmp_path: Path, most: int) -> None:
    found, is_near_cut = merged(tmp_path, most)
    wanted = gaussians([-0.5, -3, -2, 3, 4, 5.5, 12, 10.5, 30], 1)
    assert row_arrays(found).keys() == row_arrays(wanted).keys()
    for name, array in row_arrays(found).items():
        np.testing.assert_array_equal(array, row_arrays(wanted)[name])
    assert is_near_cut == [True, False, False, False, False, False, False, True, False]


def test_cores_share_what_the_scene_may_have(tmp_path: Path) -> None:
    found, is_near_cut = merged(tmp_path, 6)
    assert len(found) == len(is_near_cut) == 6
    # of each block the two that are most alike became one
    np.testing.assert_allclose(found.means_world[:, 0], [-0.5, -2.5, 3.5, 5.5, 11.25, 30], atol=0.3)
