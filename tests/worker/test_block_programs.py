"""The programs of jobs in blocks hand over through the store what makes the bytes of one process."""

import json
import uuid
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from octasplat.engine.blocks.block_plan import Block
from octasplat.engine.blocks.partition import Box
from octasplat.engine.blocks.scene_plan import ScenePlan, load_plan, save_plan
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.events import CheckpointWritten, Event
from octasplat.engine.dataset.view_tiles import Rectangles
from octasplat.engine.files.gaussian_ply import read_gaussian_ply, write_gaussian_ply
from octasplat.engine.operations.block_options import block_request
from octasplat.engine.operations.photograph_sizes import photograph_sizes
from octasplat.engine.pipeline import BlockRequest, reconstruct
from octasplat.engine.pipeline.block_request import keep_request
from octasplat.engine.pipeline.output_folder import claim_output, write_config
from octasplat.engine.runs.config import ReconstructionConfig
from octasplat.engine.train.loop.checkpoint import load_best
from octasplat.workers.db.rows import DatasetFile, Job
from octasplat.workers.storage.local import LocalStorage
from octasplat.workers.storage.trees import TreeFile
from octasplat.workers.worker import reconstruct_handler
from octasplat.workers.worker.checkpoint import Checkpoint, plan_digest
from octasplat.workers.worker.job_inputs import JobInputs, fetch_photographs
from octasplat.workers.worker.job_kinds import get_job_kind
from octasplat.workers.worker.job_kinds.reconstruct_kinds import ReconstructJobConfig
from octasplat.workers.worker.live_scene import LiveSceneWritten
from octasplat.workers.worker.reconstruct_handler import reconstruct as run_whole
from octasplat.workers.worker.reconstruct_handler import train_block
from octasplat.workers.worker.task import BlocksPlanned, Task
from octasplat.workers.worker.workspace import Workspace
from tests.support.shell_scene import shell_scene
from tests.support.wall_dataset import make_wall_dataset

pytestmark = pytest.mark.heavy

REQUESTED = {
    "train": {
        **{"iterations": 60, "rays_per_batch": 512, "sh_degree": 1, "max_gaussians": 600},
        **{"initial_points": 300, "probe_rays": 256, "checkpoint_every": 10},
        **{"background": "learnt", "exposure": "auto"},
    },
    "test_every": 4,
    "exports": ["mesh.ply"],
}
NOW = datetime.now(UTC)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_wall_dataset(tmp_path_factory.mktemp("wall"), with_masks=True, with_depths=True)


def make_job(options: dict[str, Any], role: str, attempt: int = 1) -> Job:
    """A row as a worker claims it."""
    nothing = dict.fromkeys(Job.__dataclass_fields__)
    given = {"id": uuid.uuid4(), "kind": "reconstruct", "options": options, "role": role, "attempt": attempt}
    return Job(**{**nothing, **given, "fresh_after": 0, "created_at": NOW})  # type: ignore[arg-type]


def store_photographs(scene: Path, storage: LocalStorage) -> JobInputs:
    """Photographs in the store, and their rows."""
    rows = []
    for path in sorted(path for path in scene.rglob("*") if path.is_file()):
        with storage.open_writer() as writer:
            writer.write(path.read_bytes())
            blob = writer.commit()
        rows.append(
            DatasetFile(
                uuid.uuid4(), path.relative_to(scene).as_posix(), blob.sha256, blob.size_bytes, {}, NOW
            )
        )
    dataset: Any = SimpleNamespace(id=uuid.uuid4(), name="wall")
    return JobInputs(dataset, rows, [], [], [], [])


def views_there(place: Path, folder: str) -> set[int]:
    """Numbers of the files that are not empty."""
    return {int(path.name[:3]) for path in (place / folder).iterdir() if path.stat().st_size}


def run_task(
    program: Any,
    workspace: Workspace,
    options: dict[str, Any],
    scene: Path,
    on_event: Callable[[], object] = lambda: None,
) -> tuple[list[Event], Workspace]:
    events: list[Event] = []

    def hear(event: Event) -> None:
        events.append(event)
        on_event()

    program(Task(workspace.folder, options, scene=scene, title="tiny", threads=1, progress=hear))
    return events, workspace


@pytest.mark.parametrize("reached", ["poses", "plan", "scene"])
def test_run_goes_on_where_memory_is_reckoned_otherwise_than_when_it_was_begun(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reached: str
) -> None:
    complete = get_job_kind("reconstruct").resolve({**REQUESTED, "blocks": "auto", "memory": "8G"})
    assert isinstance(complete, ReconstructJobConfig)
    most = block_request(complete, complete.run_config(), photograph_sizes(scene)).most_gaussians
    for name, kept in (("same", most), ("other", most + 1000)):
        task = Task(tmp_path / name, complete.model_dump(mode="json"), scene=scene)
        (task.run / "blocks").mkdir(parents=True)
        write_config(scene, task.run, complete.run_config(), given=None)
        keep_request(task.run, BlockRequest(most_gaussians=kept), is_new=True)
        if reached == "plan":
            nothing = Rectangles(np.zeros(0, np.int64), *np.zeros((2, 0, 2), np.int64))
            block = Block(Box(np.full(3, -np.inf), np.full(3, np.inf)), np.zeros(3), 1.0, nothing)
            save_plan(ScenePlan((block,), (0,), 10, 10, kept, True), task.run / "blocks")
        elif reached == "scene":  # the plan is not in its checkpoint any more
            write_gaussian_ply(shell_scene(20), task.run / "scene.ply")
        taken = []

        def go_on(_scene: Path, output: Path, *_: Any, blocks: BlockRequest | None, **_more: Any) -> None:
            taken.append(keep_request(output, blocks, is_new=False))  # noqa: B023

        monkeypatch.setattr(reconstruct_handler, "reconstruct_scene", go_on)
        run_whole(task)
        assert taken and set(taken) == {BlockRequest(most_gaussians=kept)}
        assert (task.run / "config.json").exists()


@pytest.mark.exhaustive
def test_programs_hand_over_what_makes_the_bytes_of_one_process(scene: Path, tmp_path: Path) -> None:
    kind = get_job_kind("reconstruct")
    complete = kind.resolve({**REQUESTED, "blocks": 2})
    assert isinstance(complete, ReconstructJobConfig)
    options = complete.model_dump(mode="json")
    whole = reconstruct(
        scene, tmp_path / "whole", complete.run_config(), threads=1, blocks=BlockRequest(count=2)
    )
    storage = LocalStorage(tmp_path / "store", floor_bytes=0)
    inputs = store_photographs(scene, storage)

    root = make_job(options, "root")
    first = Workspace(tmp_path / "work", root, storage)
    first.open()
    photographs = fetch_photographs(first, kind, complete, inputs)
    assert views_there(photographs, "images") == set(range(16))
    events, _ = run_task(run_whole, first, options, photographs)
    (planned,) = [event for event in events if isinstance(event, BlocksPlanned)]
    assert planned.numbers == (1, 2) and planned.first_iterations == 30
    assert planned.total_iterations == 30 + 2 * 30 + 100
    assert not (first.folder / "results").exists()
    # The points are shown first, and then the coarse scene.
    shown_scenes = [event for event in events if isinstance(event, LiveSceneWritten)]
    coarse = load_best(first.folder / "run" / "blocks" / "coarse").gaussians
    assert [event.step for event in shown_scenes] == [0, 30] and shown_scenes[1].gaussians == len(coarse)
    live = read_gaussian_ply(first.folder / "run" / shown_scenes[1].path)[0]
    cores = [block.core for block in load_plan(first.folder / "run" / "blocks").blocks]
    places = [coarse.means_world[core.contains(coarse.means_world)] for core in cores]
    assert shown_scenes[1].block_gaussians == tuple(map(len, places))
    assert min(map(len, places)) > 0 and np.array_equal(live.means_world, np.concatenate(places))
    cameras = json.loads((first.folder / "run" / shown_scenes[1].views).read_text())["views"]
    assert [camera["held_out"] for camera in cameras] == [view % 4 == 0 for view in range(16)]
    checkpoint = first.store_checkpoint("train", 30)
    assert checkpoint is not None
    names = {file.path.removeprefix("run/") for file in checkpoint.files}
    pieces = {"request.json", "plan.npz", "photographs.json", "coarse/best.npz", "coarse/piece.json"}
    assert {name for name in names if name.startswith("blocks/")} == {f"blocks/{name}" for name in pieces}
    assert {"config.json", "views.json", "held_out.json", "events.jsonl"} < names
    digest = plan_digest(checkpoint)
    assert len(digest) == 129

    made: list[TreeFile] = []
    # Those that show the wall from its beginning to the middle, or from there to its end, and none held out.
    shown = {1: {1, 2, 3, 5, 6, 7, 9, 10}, 2: {6, 7, 9, 10, 11, 13, 14, 15}}
    for number in (2, 1):
        given = kind.options_of_block(complete, number, 30, digest)
        block_kind = get_job_kind(kind.block_kind)
        block_options = block_kind.options.model_validate(given)
        assert block_options.number == number
        block = Workspace(tmp_path / f"other-{number}", make_job(given, "block"), storage)
        block.open()
        block.fetch_from_others(checkpoint.files)
        photographs = fetch_photographs(block, block_kind, block_options, inputs)
        assert views_there(photographs, "images") == views_there(photographs, "depths") == shown[number]
        assert views_there(photographs, "masks") == {view for view in shown[number] if view % 2}
        taken = [block.used_bytes()]
        events, _ = run_task(train_block, block, given, photographs, lambda: taken.append(block.used_bytes()))  # noqa: B023
        # the margin for records is far more than those of so small a scene
        least = planned.disk_bytes[number - 1] + checkpoint.size_bytes
        assert max(taken) <= least < 3 * max(taken) + (8 << 20)
        assert 25 in [event.iteration for event in events if isinstance(event, CheckpointWritten)]
        (shown_block,) = [event for event in events if isinstance(event, LiveSceneWritten)]
        learnt = load_best(block.folder / "run" / "blocks" / f"block_{number:03d}").gaussians
        in_core = cores[number - 1].contains(learnt.means_world)
        live = read_gaussian_ply(block.folder / "run" / shown_block.path)[0]
        assert shown_block.step == 30 and shown_block.gaussians == in_core.sum() < len(learnt)
        assert np.array_equal(live.means_world, learnt.means_world[in_core])
        own = block.store_checkpoint("train", 30)
        assert own is not None
        folder = f"run/blocks/block_{number:03d}"
        assert {file.path for file in own.files} == {f"{folder}/best.npz", f"{folder}/piece.json"}
        made += [TreeFile(path=f"run/{f.path}", sha256=f.sha256, size_bytes=f.size_bytes)
                 for f in block.store_results().files]  # fmt: skip
        block.close()
    assert len(made) == 4

    last = Workspace(tmp_path / "third", replace(root, attempt=2), storage)
    last.open()
    last.restore(Checkpoint.from_row(checkpoint.as_row()))
    last.fetch_from_others(made)
    photographs = fetch_photographs(last, kind, complete, inputs)
    events, _ = run_task(run_whole, last, options, photographs)
    assert not any(isinstance(event, BlocksPlanned | LiveSceneWritten) for event in events)
    steps = [event.iteration for event in events if isinstance(event, CheckpointWritten)]
    assert steps and min(steps) >= 30 + 2 * 30  # they count what was before
    for name in ("scene.ply", "mesh.ply", "background.exr", "views.json", "held_out.json"):
        assert (last.folder / "results" / name).read_bytes() == (whole / name).read_bytes(), name
    record = json.loads((last.folder / "results" / "training.json").read_text())
    assert list(record["pieces"]) == ["coarse", "block_001", "block_002", "finish"]
    assert record["exposures"]  # which all photographs together asked for
    assert not (last.folder / "results" / "blocks").exists()
    kept = last.store_checkpoint("export", 1)
    assert kept is not None and not any(file.path.endswith(".npz") for file in kept.files)
    for workspace in (first, last):
        workspace.close()


@pytest.mark.parametrize(
    ("record", "kept"),
    [
        ({"photographs_sha256": "a"}, [".poses.work/stored.db", "poses/images.bin", "poses/poses.json"]),
        ({"photographs_sha256": "a", "lenses": {}}, [".poses.work/stored.db"]),
        ({"moved": ["a.png"]}, [".poses.work/stored.db"]),
    ],
)
def test_job_that_begins_anew_keeps_what_its_search_has_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, record: dict[str, Any], kept: list[str]
) -> None:
    task = Task(folder=tmp_path, options=REQUESTED)
    for name in ("config.json", "blocks/request.json", ".poses.work/stored.db", "poses/images.bin"):
        (task.run / name).parent.mkdir(parents=True, exist_ok=True)
        (task.run / name).write_text("{}")
    (task.run / "poses" / "poses.json").write_text(json.dumps(record))
    found = list[list[str]]()

    def refuse_what_was_there(task: Task) -> None:
        files = (path for path in task.run.rglob("*") if path.is_file())
        found.append(sorted(path.relative_to(task.run).as_posix() for path in files))
        if len(found) == 1:
            raise ConfigError("It has other settings.")

    monkeypatch.setattr(reconstruct_handler, "_run_reconstruction", refuse_what_was_there)
    run_whole(task)
    assert found[1] == kept
    claim_output(tmp_path, task.run, ReconstructionConfig(poses="auto"), resume=True)
