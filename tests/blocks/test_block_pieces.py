"""Pieces of a run in blocks made in folders of their own, as by several machines, give the run's bytes."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.blocks.scene_plan import has_plan, load_plan, save_plan
from octasplat.engine.core import versions
from octasplat.engine.core.errors import CheckpointError
from octasplat.engine.core.events import Event, RunFinished, TrainingProgress
from octasplat.engine.pipeline import (
    BlockRequest,
    PlanBlocks,
    TrainBlock,
    block_files,
    missing_blocks,
    planned_blocks,
    reconstruct,
)
from octasplat.engine.pipeline.reconstruction import RESULT_STEPS
from octasplat.engine.runs.config import ReconstructionConfig, resolve_config
from tests.support.tiny_dataset import make_tiny_dataset

pytestmark = pytest.mark.heavy

CONFIG: ReconstructionConfig = resolve_config(
    "standard",
    assignments=[
        *("iterations=40", "rays_per_batch=512", "sh_degree=1", "max_gaussians=600", "initial_points=300"),
        *("probe_rays=256", "test_every=4", 'background="learnt"', "exposure=true", "exports=[]"),
    ],
)
WITHOUT_OUTPUTS = shutil.ignore_patterns("cache", "checkpoints")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_dataset(tmp_path_factory, views=12, width_px=64, height_px=48)


@pytest.mark.exhaustive
@pytest.mark.parametrize("most_gaussians", [None, 450])
def test_pieces_in_folders_of_their_own_give_the_same_bytes(
    scene: Path, tmp_path: Path, most_gaussians: int | None
) -> None:
    blocks = BlockRequest(count=2, most_gaussians=most_gaussians)
    whole = reconstruct(scene, tmp_path / "whole", CONFIG, threads=1, blocks=blocks)
    events: list[Event] = []
    first = reconstruct(
        scene, tmp_path / "first", CONFIG, threads=2, blocks=blocks, steps=(PlanBlocks(),),
        progress=events.append,
    )  # fmt: skip
    assert not any(isinstance(event, RunFinished) for event in events)
    plan = planned_blocks(first)
    assert plan is not None and missing_blocks(first, plan) == (1, 2)
    assert plan.last_piece == ("finish" if most_gaussians is None else "polish")
    assert not (first / "scene.ply").exists()
    for number in (2, 1):
        other = tmp_path / f"other-{number}"
        shutil.copytree(first, other, ignore=WITHOUT_OUTPUTS)
        reconstruct(scene, other, CONFIG, resume=True, threads=1, steps=(TrainBlock(number),))
        target = first / "blocks" / f"block_{number:03d}"
        target.mkdir()
        for path in block_files(other, number):
            shutil.copy(path, target)
    assert missing_blocks(first, plan) == ()
    last = tmp_path / "last"
    shutil.copytree(first, last, ignore=WITHOUT_OUTPUTS)
    reconstruct(scene, last, CONFIG, resume=True, threads=1)
    for name in ("scene.ply", "background.exr"):
        assert (last / name).read_bytes() == (whole / name).read_bytes(), name
    assert planned_blocks(last) is None


def test_plan_is_read_as_it_was_written(scene: Path, tmp_path: Path) -> None:
    events: list[Event] = []
    run = reconstruct(
        scene, tmp_path / "run", CONFIG, threads=1, blocks=BlockRequest(count=3), steps=(PlanBlocks(),),
        progress=events.append,
    )  # fmt: skip
    plan = load_plan(run / "blocks")
    totals = {event.total_iterations for event in events if isinstance(event, TrainingProgress)}
    assert totals == {sum(plan.expected_iterations().values())}  # known before it is planned
    assert len(plan.blocks) == 3 and plan.most_gaussians is None and plan.coarse_iterations == 20
    assert np.isinf(plan.blocks[0].core.low_world).any()
    assert plan.expected_iterations()["coarse"] == 20
    assert all(block.pixels.pixel_count > 0 for block in plan.blocks)
    path = run / "blocks" / "plan.npz"
    whole = path.read_bytes()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(versions, "RESULTS_VERSION", versions.RESULTS_VERSION + 1)
        for steps in (RESULT_STEPS, (TrainBlock(1),)):
            with pytest.raises(CheckpointError, match="other results; go on with that version"):
                reconstruct(scene, run, CONFIG, resume=True, threads=1, steps=steps)
        save_plan(replace(plan, results=versions.RESULTS_VERSION), tmp_path)
    assert (tmp_path / "plan.npz").read_bytes() != whole  # jobs tell plans by their digests
    save_plan(load_plan(run / "blocks"), tmp_path)
    assert (tmp_path / "plan.npz").read_bytes() == whole
    # a flipped bit asks for a password, or for a zip file of the future
    for offset, value in ((8, 1), (6, 99)):
        place = whole.index(b"PK\x01\x02") + offset
        path.write_bytes(whole[:place] + bytes([value]) + whole[place + 1 :])
        with pytest.raises(CheckpointError, match=r"plan\.npz cannot be read"):
            load_plan(run / "blocks")
    path.write_bytes(whole[:200])
    with pytest.raises(CheckpointError, match=r"plan\.npz cannot be read"):
        reconstruct(scene, run, CONFIG, resume=True, threads=1, steps=(TrainBlock(1),))


def test_one_block_has_no_plan(scene: Path, tmp_path: Path) -> None:
    run = reconstruct(scene, tmp_path / "run", CONFIG, blocks=BlockRequest(), steps=(PlanBlocks(),))
    assert not has_plan(run / "blocks") and planned_blocks(run) is None
