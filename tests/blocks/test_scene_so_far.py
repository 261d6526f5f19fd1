"""A run in blocks is shown while it goes on: what its blocks have learnt, and the coarse scene elsewhere."""

import urllib.request
from pathlib import Path

import numpy as np

import octasplat as osp
from octasplat.engine.blocks.block_plan import Block
from octasplat.engine.blocks.partition import Box
from octasplat.engine.blocks.scene_plan import COARSE, ScenePlan, save_plan
from octasplat.engine.dataset.view_tiles import Rectangles
from octasplat.engine.files import read_scene
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.train.loop.checkpoint import BestState, save_best


def gaussians(x: list[float], degree: int) -> FlatGaussians:
    """Some along an axis."""
    count = len(x)
    means = np.zeros((count, 3), np.float32)
    means[:, 0] = x
    return FlatGaussians(
        means_world=means,
        quats_wxyz=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        log_scales=np.zeros((count, 2), np.float32),
        opacity_logits=np.zeros(count, np.float32),
        sh=np.ones((count, (degree + 1) ** 2, 3), np.float32),
    )


def make_run(folder: Path) -> None:
    """A run in two blocks, cut at 0, of which none is trained."""
    nothing = Rectangles(np.zeros(0, np.int64), np.zeros((0, 2), np.int64), np.zeros((0, 2), np.int64))
    far = np.full(3, np.inf)
    boxes = (Box(-far, np.array([0.0, np.inf, np.inf])), Box(np.array([0.0, -np.inf, -np.inf]), far))
    blocks = tuple(Block(box, np.ones(3), 0.5, nothing) for box in boxes)
    pieces = folder / "blocks"
    save_piece(gaussians([1, -1, 2, -2, 3], 0), pieces / COARSE)
    save_plan(ScenePlan(blocks, (10, 10), 5, 5, None, True), pieces)


def save_piece(found: FlatGaussians, folder: Path) -> None:
    folder.mkdir(parents=True)
    save_best(BestState(found, {}), folder)


def shown_places(folder: Path, scratch: Path) -> list[float]:
    """Where the Gaussians are that the viewer of a run shows."""
    with osp.view(folder, open_browser=False) as viewer:
        scratch.write_bytes(urllib.request.urlopen(f"{viewer.url}scene.ply", timeout=30).read())
    places: list[float] = read_scene(scratch)[0].means_world[:, 0].tolist()
    return places


def test_view_shows_what_blocks_have_learnt_so_far(tmp_path: Path) -> None:
    run, scratch = tmp_path / "run", tmp_path / "shown.ply"
    make_run(run)
    assert shown_places(run, scratch) == [-1, -2, 1, 2, 3]
    # Of what a block has learnt its core is shown, not what it has learnt around it.
    save_piece(gaussians([-0.5, 5, 0.5, 0.75], 2), run / "blocks" / "block_002")
    assert shown_places(run, scratch) == [-1, -2, 5, 0.5, 0.75]
    assert read_scene(scratch)[0].sh_degree == 2
    osp.save(osp.Scene(gaussians([7], 0)), run / "scene.ply")
    assert shown_places(run, scratch) == [7]
