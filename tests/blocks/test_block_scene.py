"""A scene trained in blocks: as good as the whole, without seams, and the same bytes after any stop."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from octasplat.engine.blocks.block_plan import plan_blocks
from octasplat.engine.blocks.piece_settings import FINISHED_MARGIN, MARGIN
from octasplat.engine.blocks.piece_training import RESULT
from octasplat.engine.blocks.scene_plan import load_plan
from octasplat.engine.core.errors import CancelledError, ConfigError
from octasplat.engine.core.events import CheckpointWritten, Event, HeldOutMeasured, Noted, TrainingProgress
from octasplat.engine.dataset import Dataset
from octasplat.engine.files.gaussian_ply import read_gaussian_ply
from octasplat.engine.pipeline import BlockRequest, reconstruct
from octasplat.engine.runs.config import ReconstructionConfig, resolve_config
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.train.loop.checkpoint import load_best
from tests.support.tiny_dataset import make_tiny_dataset

pytestmark = pytest.mark.heavy

MAX_LOSS_DB = 0.5
"""Of two blocks against the whole, of as many iterations each."""


def make_config(**assignments: object) -> ReconstructionConfig:
    values: dict[str, object] = {
        "iterations": 300,
        "rays_per_batch": 1024,
        "sh_degree": 1,
        "max_gaussians": 2000,
        "initial_points": 800,
        "densify_from_iter": 20,
        "densify.start": 20,
        "densify.interval": 20,
        "checkpoint_every": 100,
        "probe_rays": 512,
        "early_stopping_db": 0,
        "test_every": 4,
        "exports": [],
        "background": "learnt",
        "exposure": True,
        **assignments,
    }
    return resolve_config("standard", assignments=[f"{k}={json.dumps(v)}" for k, v in values.items()])


def make_short_config() -> ReconstructionConfig:
    """Settings of a run of which only the bytes are of interest."""
    return make_config(iterations=60, checkpoint_every=10)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_dataset(
        tmp_path_factory, views=40, width_px=96, height_px=72, samples_per_side=2, points=800
    )


@pytest.fixture(scope="module")
def two_blocks(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Event]]:
    """A run in two blocks that nothing stopped, on one thread."""
    events: list[Event] = []
    output = tmp_path_factory.mktemp("blocks") / "run"
    blocks = BlockRequest(count=2)
    reconstruct(scene, output, make_config(), threads=1, blocks=blocks, progress=events.append)
    return output, events


@pytest.fixture(scope="module")
def short_blocks(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run in two blocks that nothing stopped, on one thread."""
    output = tmp_path_factory.mktemp("short") / "run"
    return reconstruct(scene, output, make_short_config(), threads=1, blocks=BlockRequest(count=2))


@pytest.fixture(scope="module")
def whole(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run without blocks."""
    return reconstruct(scene, tmp_path_factory.mktemp("whole") / "run", make_config(), threads=1)


@pytest.fixture(scope="module")
def polished_blocks(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run in two blocks that no training may hold together, so that those near the cut are polished."""
    output = tmp_path_factory.mktemp("polished") / "run"
    reconstruct(scene, output, make_config(), threads=1, blocks=BlockRequest(count=2, most_gaussians=1500))
    return output


def psnr(run: Path) -> float:
    return float(json.loads((run / "metrics.json").read_text())["mean"]["psnr"])


@pytest.mark.exhaustive
def test_two_blocks_are_as_good_as_the_whole(two_blocks: tuple, whole: Path) -> None:
    assert psnr(two_blocks[0]) > psnr(whole) - MAX_LOSS_DB
    assert not (whole / "blocks").exists()


@pytest.mark.exhaustive
def test_blocks_that_fit_together_are_finished_together(scene: Path, two_blocks: tuple) -> None:
    """Those that fit into one training all move on, and exposures are learnt again."""
    run, _ = two_blocks
    # those of held-out views are estimated by each training
    trained = Dataset.open(scene, run / "cache", test_every=4).train_indices
    coarse, finished = (load_best(run / "blocks" / name) for name in ("coarse", "finish"))
    merged, _ = read_gaussian_ply(run / "scene.ply")
    np.testing.assert_array_equal(merged.means_world, finished.gaussians.means_world)
    blocks = [load_best(run / "blocks" / f"block_{number:03d}") for number in (1, 2)]
    for block in blocks:
        kept, known = (piece.shading["exposure.offsets"][trained] for piece in (block, coarse))
        np.testing.assert_allclose(kept, known, atol=1e-5)
        assert not np.isin(block.gaussians.means_world, merged.means_world).any()
    assert np.abs(finished.shading["exposure.offsets"] - coarse.shading["exposure.offsets"]).max() > 1e-4


@pytest.mark.exhaustive
def test_merged_scene_numbers_one_core_after_the_other(scene: Path, polished_blocks: Path) -> None:
    """Each block's kept Gaussians are those in its box, in its order; only those near the cut move on."""
    run = polished_blocks
    record = json.loads((run / "training.json").read_text())
    assert list(record["pieces"]) == ["coarse", "block_001", "block_002", "polish"]
    assert record["iterations"] == 150 + 300 * 2 + 30
    merged, _ = read_gaussian_ply(run / "scene.ply")
    told = [json.loads(row) for row in (run / "events.jsonl").read_text().splitlines()]
    last = [row for row in told if row["kind"] == TrainingProgress.kind][-1]
    assert last["gaussians"] == len(merged)  # not only those that the polish has trained
    dataset = Dataset.open(scene, run / "cache", test_every=4)
    coarse = load_best(run / "blocks" / "coarse").gaussians
    tracer = make_tracer(make_config().train.trace, threads=1)
    blocks = plan_blocks(dataset, coarse, 2, tracer, lambda: None)
    cores = []
    for number, block in enumerate(blocks, start=1):
        trained = load_best(run / "blocks" / f"block_{number:03d}").gaussians
        cores.append(trained.select(block.core.contains(trained.means_world)))
    total = sum(len(core) for core in cores)
    assert 2000 < total < 1.2 * 2000 and len(merged) == 2000  # pairs that look alike became one
    first = 0
    for block, core in zip(blocks, cores, strict=True):
        count = round(2000 * len(core) / total)
        part = merged.select(slice(first, first + count))
        first += count
        is_inner = block.core.grown(-block.margin_world).contains(core.means_world)
        assert 0 < is_inner.sum() < len(core)
        stays = [np.isin(core.sh[rows, 0, 0], part.sh[:, 0, 0]).sum() for rows in (is_inner, ~is_inner)]
        assert is_inner.sum() - stays[0] <= 2 * (len(core) - count)
        assert stays[1] < 0.1 * (~is_inner).sum()  # the polish has moved these


@pytest.mark.exhaustive
def test_margin_is_narrow_where_blocks_are_finished_together(
    two_blocks: tuple, polished_blocks: Path
) -> None:
    together, polished = (load_plan(run / "blocks") for run in (two_blocks[0], polished_blocks))
    assert together.is_finished_together and not polished.is_finished_together
    for narrow, wide in zip(together.blocks, polished.blocks, strict=True):
        np.testing.assert_allclose(
            narrow.margin_world / FINISHED_MARGIN, wide.margin_world / MARGIN, rtol=1e-12
        )


@pytest.mark.exhaustive
def test_progress_counts_all_trainings(two_blocks: tuple) -> None:
    run, events = two_blocks
    told = [event for event in events if isinstance(event, TrainingProgress)]
    assert [event.iteration for event in told] == sorted(event.iteration for event in told)
    assert told[-1].iteration == told[-1].total_iterations == 150 + 150 * 2 + 500
    assert told[-1].seconds_left == 0
    # held-out views are those of the whole scene at its full size: of the coarse one nothing is told
    measured = [event for event in events if isinstance(event, HeldOutMeasured)]
    assert measured[0].iteration == 150 + 150 * 2 and measured[-1].iteration == told[-1].iteration
    assert measured[0].seconds <= measured[-1].seconds <= told[-1].seconds + 1
    record = json.loads((run / "training.json").read_text())
    assert record["iterations"] == 950
    assert list(record["pieces"]) == ["coarse", "block_001", "block_002", "finish"]
    assert len(record["exposures"]) == 40
    assert sum("Block " in event.message for event in events if isinstance(event, Noted)) == 2
    assert not any((run / "blocks").rglob("checkpoints"))


def stop_at(condition: Callable[[Event], bool]) -> tuple[Callable[[Event], None], Callable[[], bool]]:
    """A listener, and a question whether to stop that is answered by yes once an event meets a condition."""
    met: list[Event] = []

    def listen(event: Event) -> None:
        if condition(event):
            met.append(event)

    return listen, lambda: bool(met)


@pytest.mark.exhaustive
@pytest.mark.parametrize("place", ["coarse", "block_001", "block_002", "finish"])
def test_stopped_run_ends_with_the_same_bytes(
    scene: Path, short_blocks: Path, tmp_path: Path, place: str
) -> None:
    run = tmp_path / "run"

    def is_there(event: Event) -> bool:
        return isinstance(event, CheckpointWritten) and place in event.path

    listen, should_stop = stop_at(is_there)
    with pytest.raises(CancelledError):
        reconstruct(
            scene, run, make_short_config(), threads=2, blocks=BlockRequest(count=2), progress=listen,
            should_stop=should_stop,
        )  # fmt: skip
    assert not (run / "scene.ply").exists()
    assert not (run / "blocks" / place / RESULT).exists()
    reconstruct(scene, run, make_short_config(), threads=2, resume=True)  # the blocks are remembered
    assert (run / "scene.ply").read_bytes() == (short_blocks / "scene.ply").read_bytes()
    assert (run / "background.exr").read_bytes() == (short_blocks / "background.exr").read_bytes()


def test_automatic_blocks_of_a_small_scene_are_an_ordinary_run(scene: Path, tmp_path: Path) -> None:
    config = make_config(iterations=30, background="black", exposure=False)
    runs = [
        reconstruct(scene, tmp_path / name, config, threads=1, blocks=blocks)
        for name, blocks in (("none", None), ("one", BlockRequest(count=1)), ("auto", BlockRequest()))
    ]
    contents = [(run / "scene.ply").read_bytes() for run in runs]
    assert contents[0] == contents[1] == contents[2]


def test_memory_decides_the_number_of_blocks(scene: Path, tmp_path: Path) -> None:
    dataset, config = Dataset.open(scene, tmp_path / "cache"), make_config(background="black", exposure=False)
    assert BlockRequest(most_gaussians=2000).resolve(config, dataset) == 1
    assert BlockRequest(most_gaussians=900).resolve(config, dataset) == 3
    assert BlockRequest(count=5, most_gaussians=900).resolve(config, dataset) == 5


@pytest.mark.parametrize(
    ("setting", "name"), [({"refine_poses": True}, "refine_poses"), ({"loss.free_space": 0.1}, "free_space")]
)
def test_unsupported_settings_are_refused_before_anything_is_made(
    scene: Path, tmp_path: Path, setting: dict, name: str
) -> None:
    with pytest.raises(ConfigError, match=name):
        reconstruct(scene, tmp_path / "run", make_config(**setting), blocks=BlockRequest(count=2))
    assert not (tmp_path / "run").exists()


@pytest.mark.exhaustive
def test_other_blocks_than_the_run_s_own_are_refused(scene: Path, two_blocks: tuple) -> None:
    for blocks in (BlockRequest(count=3), BlockRequest(count=1), BlockRequest()):
        with pytest.raises(ConfigError, match="other blocks"):
            reconstruct(scene, two_blocks[0], make_config(), resume=True, blocks=blocks)


@pytest.mark.exhaustive
def test_no_seam_is_seen_around_the_cut(scene: Path, two_blocks: tuple, whole: Path) -> None:
    """What blocks lose against the whole is not more where the Gaussians beside the cut are seen."""
    run, config = two_blocks[0], make_config()
    dataset = Dataset.open(scene, run / "cache", test_every=4)
    tracer = make_tracer(config.train.trace, threads=1)
    coarse = load_best(run / "blocks" / "coarse").gaussians
    blocks = plan_blocks(dataset, coarse, 2, tracer, lambda: None)
    merged, _ = read_gaussian_ply(run / "scene.ply")
    means = merged.means_world
    is_near = np.all([~block.core.grown(-block.margin_world).contains(means) for block in blocks], axis=0)
    tracer.build(merged, is_near.astype(np.float32)[:, None])
    errors: dict[str, list[np.ndarray]] = {"blocks": [], "whole": [], "near": []}
    for view in dataset.test_indices.tolist():
        rays = dataset.view_rays(view)
        errors["near"].append(tracer.trace(rays.rays).features[:, 0] > 0.5)
        photograph, _, _ = dataset.view_image(view)
        for name, folder in (("blocks", run), ("whole", whole)):
            (path,) = (folder / "renders").rglob(f"{Path(dataset.views[view].name).stem}*.png")
            rendered = np.asarray(Image.open(path).convert("RGB"), np.float64) / 255
            errors[name].append(((rendered - photograph) ** 2).mean(axis=2).ravel())
    near = np.concatenate(errors["near"])
    assert 0.02 < near.mean() < 0.9
    blocks_error, whole_error = (np.concatenate(errors[name]) for name in ("blocks", "whole"))
    loss_db = [10 * np.log10(blocks_error[part].mean() / whole_error[part].mean()) for part in (near, ~near)]
    assert loss_db[0] < loss_db[1] + MAX_LOSS_DB
