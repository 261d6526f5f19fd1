"""Lit GLBs in Cycles and in three.js beside ``octasplat relight`` and, where it is known, the truth.

    octasplat surface OUT --materials -o thing.glb
    python benchmarks/surface_materials.py OUT thing.glb --other-dataset SCENE/test --environment other.hdr

The light is OUT/environment.hdr and each ``--environment``; pictures are at the views of
``--other-dataset``, over black. Truth:
the photographs under the first, and what ``truth.json`` names under the others. Needs node,
Chromium and OCTASPLAT_BPY_PYTHON. PSNR of display values, means over the views: of the whole picture, and of
the pixels that our picture covers.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32

from octasplat.engine.dataset import Dataset, load_dataset_model
from octasplat.engine.evaluate.ground_truth import GROUND_TRUTH_FILE, GroundTruth, read_ground_truth
from octasplat.engine.files import read_scene
from octasplat.engine.pathtracing.environment import EnvironmentMap, environment_frame
from octasplat.engine.pathtracing.relighting.path_relighter import PathRelighter
from octasplat.engine.pathtracing.relighting.split_sum_relighter import SplitSumRelighter
from octasplat.engine.pathtracing.stage.model import Integrator
from octasplat.engine.render.environment_files import read_environment
from octasplat.engine.render.image_files import read_image, write_png
from octasplat.engine.runs.config import read_config
from octasplat.engine.runs.run_folder import CONFIG, ENVIRONMENT_HDR, SCENE, run_viewpoints
from octasplat.engine.surface.depth_cameras import photograph_cameras
from tests.support.lit_surface import render_in_cycles, render_in_threejs, view_of

Image = Float32[np.ndarray, "h w 3"]
DEPTH = 6
BLACK = np.zeros(3, np.float32)


class Table:
    """Decibels of pictures by what they are and what they are compared with."""

    def __init__(self) -> None:
        self._found: dict[tuple[str, str], list[tuple[float, float]]] = {}

    def add(self, label: str, image: Image, to: str, other: Image, mask: Bool[np.ndarray, "h w"]) -> None:
        """Compare two pictures."""
        errors = (image.astype(np.float64) - other) ** 2
        pair = (-10 * np.log10(errors.mean()), -10 * np.log10(errors[mask].mean()))
        self._found.setdefault((label, to), []).append(pair)

    def rows(self) -> list[str]:
        """Means over what was added: whole picture / what is covered."""
        return [
            f"{label} to {to}: " + " / ".join(f"{value:.1f}" for value in np.mean(pairs, axis=0))
            for (label, to), pairs in self._found.items()
        ]


def true_picture(
    truth: GroundTruth | None, photographs: Dataset, light: Path, run: Path, number: int, side: int
) -> Image | None:
    """What is known of a view under a light, over black."""
    view = photographs.views[number]
    if light == run / ENVIRONMENT_HDR:
        image = read_image(view.image_path)
        return image[..., :3] * image[..., 3:] if image.shape[2] == 4 else image[..., :3]
    for folder, path in truth.relit_folders if truth else ():
        if path.stem == light.stem:
            return truth.relit_image(folder, view.name, side)[..., :3]
    return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("glb", type=Path, nargs="+")
    parser.add_argument("--other-dataset", type=Path, required=True)
    parser.add_argument("--environment", type=Path, action="append", default=[])
    parser.add_argument("--views", type=int, default=2)
    parser.add_argument("--max-side", type=int, default=400)
    parser.add_argument("--samples", type=int, default=128)
    parser.add_argument("--output", type=Path, help="folder for the pictures, side by side")
    asked = parser.parse_args()

    config = read_config(asked.run / CONFIG)
    gaussians = read_scene(asked.run / SCENE)[0]
    frame = environment_frame(np.array(config.train.materials.up_world, np.float64))
    trace, extent = config.train.trace, run_viewpoints(asked.run).extent
    paths = Integrator(samples=asked.samples, max_depth=DEPTH, roulette_depth=DEPTH)
    by = {
        "path": PathRelighter(gaussians, trace, paths),
        "split sum": SplitSumRelighter(gaussians, trace, config.train.materials, extent_world=extent),
    }
    places = [
        path
        for path in (asked.other_dataset / GROUND_TRUTH_FILE, asked.other_dataset.parent / GROUND_TRUTH_FILE)
        if path.is_file()
    ]
    truth = read_ground_truth(places[0]) if places else None
    photographs = load_dataset_model(
        asked.other_dataset, max_side=asked.max_side, min_views=1, for_training=False
    )
    names = [view.name for view in photographs.views]
    wanted = [name for name in (truth.content.relight.views if truth else names) if name in names]

    for light in (asked.run / ENVIRONMENT_HDR, *asked.environment):
        environment = EnvironmentMap(read_environment(light), frame)
        for relighter in by.values():
            relighter.put(environment)
        table, took = Table(), {}
        for name in wanted[:: max(1, len(wanted) // asked.views)][: asked.views]:
            number = names.index(name)
            camera = photograph_cameras(photographs, np.array([number]), asked.max_side)[0]
            view = view_of(camera, frame)
            relit = {label: relighter.render(camera.rays()) for label, relighter in by.items()}
            pictures = {label: np.clip(image.over(BLACK), 0, 1) for label, image in relit.items()}
            mask = relit["path"].coverage > 0.5
            table.add("path", pictures["path"], "split sum", pictures["split sum"], mask)
            for glb in asked.glb:
                for program, ours in (("Cycles", "path"), ("three.js", "split sum")):
                    start, label = time.perf_counter(), f"{glb.name} in {program}"
                    if program == "Cycles":
                        seen = render_in_cycles(glb, light, view, asked.samples)
                    else:
                        seen = render_in_threejs(glb, light, view)
                    took[label] = time.perf_counter() - start
                    pictures[label] = np.clip(seen, 0, 1)
                    table.add(label, pictures[label], ours, pictures[ours], mask)
            true = true_picture(truth, photographs, light, asked.run, number, asked.max_side)
            if true is not None:
                for label, image in pictures.items():
                    table.add(label, image, "truth", true, mask)
                pictures["truth"] = true
            if asked.output:
                strip = np.concatenate(list(pictures.values()), axis=1)
                write_png(asked.output / f"{light.stem}_{Path(name).stem}.png", strip)
        print(f"{light.name}, {asked.views} views, whole picture / covered, dB")
        print("\n".join(f"  {row}" for row in table.rows()))
        print("  " + ", ".join(f"{label} {seconds:.0f} s" for label, seconds in took.items()), flush=True)


if __name__ == "__main__":
    main()
