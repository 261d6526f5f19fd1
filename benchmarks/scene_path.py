"""The way of one scene through the main job: the rooms that the pipeline asks, in order, and its returns.

    python -m benchmarks.scene_path                     # this tree
    python -m benchmarks.scene_path --root ELSEWHERE    # another checkout

A small generated scene is reconstructed while every call that ``engine/pipeline`` makes into another
folder of the engine is noted. A return is a visit to a folder that was left before.
"""

import argparse
import sys
import tempfile
from pathlib import Path
from types import FrameType
from typing import Any

PIPELINE = "octasplat.engine.pipeline"
SETTINGS = {
    "iterations": "30",
    "rays_per_batch": "256",
    "max_gaussians": "400",
    "initial_points": "300",
    "probe_rays": "256",
}


class Visits:
    """A profiler that notes calls out of the pipeline."""

    def __init__(self) -> None:
        self.rooms: list[str] = []

    def __call__(self, frame: FrameType, event: str, _argument: Any) -> None:
        """Note ``frame`` if the pipeline has called it."""
        if event != "call" or frame.f_back is None:
            return
        caller, callee = (f.f_globals.get("__name__", "") for f in (frame.f_back, frame))
        inside = (caller.startswith(PIPELINE), callee.startswith(PIPELINE))
        if inside == (True, False) and callee.startswith("octasplat.engine."):
            room = callee.split(".")[2]
            if not self.rooms or self.rooms[-1] != room:
                self.rooms.append(room)


def main() -> None:
    """Reconstruct and tell."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, default=Path(__file__).resolve().parent.parent)
    sys.path.insert(0, str(parser.parse_args().root.resolve() / "src"))
    from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
    from octasplat.engine.pipeline import reconstruct
    from octasplat.engine.runs.config import resolve_config

    with tempfile.TemporaryDirectory() as folder:
        scene, output = Path(folder) / "scene", Path(folder) / "output"
        config = SyntheticDatasetConfig(views=8, width_px=64, height_px=48, samples_per_side=1, points=200)
        write_synthetic_dataset(scene, config)
        settings = resolve_config("fast", assignments=[f"{name}={value}" for name, value in SETTINGS.items()])
        reconstruct(scene, Path(folder) / "warm", settings, threads=1)  # compiles, which takes no profiler
        visits = Visits()
        sys.setprofile(visits)
        try:
            reconstruct(scene, output, settings, threads=1)
        finally:
            sys.setprofile(None)
    everywhere = {"errors", "events", "stages", "threads", "writing", "versions", "config"}
    rooms = [room for room in visits.rooms if room not in everywhere]
    path = [room for place, room in enumerate(rooms) if place == 0 or rooms[place - 1] != room]
    print(" -> ".join(path))
    print(f"{len(set(path))} rooms, {len(path)} visits, {len(path) - len(set(path))} returns")


if __name__ == "__main__":
    main()
