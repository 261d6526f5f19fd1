"""Peak memory and CPU time of the end of a scene in blocks: merge, polish near the cuts, last shading.

    python -m benchmarks.merge_memory [COUNT ...] [--blocks 4] [--near-cut 0.1] [--limit SHARE]

Random Gaussians stand for trained blocks, and the polish is of a few iterations on small photographs, so
that memory is that of the Gaussians. The end runs in a process of its own, whose anonymous memory another one
reads, as in :mod:`benchmarks.export_memory`.
"""

import argparse
import hashlib
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.export_memory import DONE, READY, measured, random_scene, scene_bytes, tell
from octasplat.engine.blocks.block_merge import finish_scene
from octasplat.engine.blocks.block_plan import Block
from octasplat.engine.blocks.partition import cut_into_boxes
from octasplat.engine.blocks.piece_progress import PieceProgress
from octasplat.engine.blocks.piece_training import BlockWork
from octasplat.engine.blocks.scene_plan import COARSE, ScenePlan, block_name
from octasplat.engine.core.events import ignore_events
from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.dataset.view_tiles import Rectangles
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.rows import row_arrays
from octasplat.engine.runs.config import resolve_config
from octasplat.engine.train.loop.checkpoint import BestState, save_best

SH_DEGREE = 3


def make_plan(scene: FlatGaussians, blocks: int, near_cut: float) -> ScenePlan:
    """Return a plan whose blocks have so many of their Gaussians near to cuts, roughly."""
    boxes = cut_into_boxes(scene.means_world[:10_000], np.ones(min(10_000, len(scene))), blocks)
    pixels = Rectangles(np.arange(8), np.zeros((8, 2), np.int64), np.full((8, 2), 16))
    # of a normal distribution of deviation 3, about its middle
    margin = np.full(3, 3.0 * near_cut)
    cut = tuple(Block(box, margin, 1.0 / blocks, pixels) for box in boxes)
    return ScenePlan(cut, (1,) * blocks, 1, 1, None, is_finished_together=False)


def make_pieces(folder: Path, count: int, blocks: int, near_cut: float) -> None:
    """Write photographs, the coarse scene and the trained blocks."""
    write_synthetic_dataset(
        folder / "scene",
        SyntheticDatasetConfig(views=8, width_px=64, height_px=48, samples_per_side=1, points=400),
    )
    scene = random_scene(count, SH_DEGREE)
    scene.log_scales += np.float32(np.log((1e6 / count) ** 0.5))  # which cover about the same
    pieces = folder / "pieces"
    for number, block in enumerate(make_plan(scene, blocks, near_cut).blocks, start=1):
        save_piece(scene.select(block.trained.contains(scene.means_world)), pieces / block_name(number))
    save_piece(scene.select(slice(0, 1000)), pieces / COARSE)


def save_piece(gaussians: FlatGaussians, folder: Path) -> None:
    """Write what a piece has come to."""
    folder.mkdir(parents=True, exist_ok=True)
    save_best(BestState(gaussians, {}), folder)


def work(folder: Path, count: int, blocks: int, near_cut: float, limit: float) -> None:
    """Finish a scene in this process; the other one is told where that begins and ends."""
    values = {
        "iterations": 100, "rays_per_batch": 256, "sh_degree": SH_DEGREE, "test_every": 4, "exports": [],
        "max_gaussians": round(limit * count), "probe_rays": 256,
    }  # fmt: skip
    config = resolve_config("standard", assignments=[f"{name}={value}" for name, value in values.items()])
    pieces = folder / "pieces"
    dataset = Dataset.open(folder / "scene", folder / "cache", test_every=4)
    plan = make_plan(random_scene(10_000, 0), blocks, near_cut)  # whose places are those of the first of more
    settings = config.train.model_copy(update={"exposure": False})
    block_work = BlockWork(dataset, settings, pieces, 2, ignore_events, lambda: False)
    progress = PieceProgress(ignore_events)
    progress.expect(plan.expected_iterations())
    tell(READY)
    began = time.process_time()
    found = finish_scene(block_work, plan, progress).gaussians
    seconds = time.process_time() - began
    digest = hashlib.sha256()
    for name, array in sorted(row_arrays(found).items()):
        digest.update(name.encode() + np.ascontiguousarray(array).tobytes())
    print(f"{len(found):,} Gaussians, digest {digest.hexdigest()[:16]}", file=sys.stderr)
    tell(f"{DONE} {seconds} {len(found)}")


def main() -> None:
    """Print a row for each count."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("counts", nargs="*", type=int, default=[500_000, 2_000_000])
    parser.add_argument("--blocks", type=int, default=4)
    parser.add_argument("--near-cut", type=float, default=0.1)
    parser.add_argument("--limit", type=float, default=0.0, help="most Gaussians, as a share of those given")
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--step", action="store_true")
    given = parser.parse_args()
    if given.step:
        work(given.folder, given.counts[0], given.blocks, given.near_cut, given.limit)
        return
    for count in given.counts:
        with tempfile.TemporaryDirectory(dir=given.folder) as place:
            make_pieces(Path(place), count, given.blocks, given.near_cut)
            command = ["benchmarks.merge_memory", str(count), "--step", "--folder", place]
            command += ["--blocks", str(given.blocks), "--near-cut", str(given.near_cut)]
            seconds, peak, found = measured([*command, "--limit", str(given.limit)])
        size = scene_bytes(1, SH_DEGREE)
        print(
            f"{count:>10,} in {given.blocks} blocks, {found:,} at the end: {peak / found:8.1f} B a Gaussian "
            f"of {size}, {peak / 1e6:8.0f} MB, {seconds:7.1f} s of CPU",
            flush=True,
        )


if __name__ == "__main__":
    main()
