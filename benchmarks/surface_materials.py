"""A lit GLB in Cycles and in three.js beside ``octasplat relight`` and, where it is known, the truth.

    octasplat surface OUT --materials -o thing.glb
    python benchmarks/surface_materials.py OUT thing.glb --on SCENE/test --environment other.hdr --views 2

The light is OUT/environment.hdr and each ``--environment``; pictures are at the views of ``--on``, over
black. Truth: the photographs under the first, and what ``truth.json`` names under the others. Needs node,
Chromium and OCTASPLAT_BPY_PYTHON. PSNR of display values, of the whole picture and of the pixels that our
picture covers.
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from engine.config import read_config
from engine.evaluate.truth import TRUTH, Truth, read_truth
from engine.files import read_scene
from engine.light.environment import EnvironmentMap, environment_frame, read_environment
from engine.light.relighting import PathRelighter
from engine.light.split_sum_relighting import SplitSumRelighter
from engine.light.stage import Integrator
from engine.render.images import read_image, write_png
from engine.run_folder import CONFIG, ENVIRONMENT, SCENE, run_viewpoints
from engine.scene import Dataset, load_scene
from engine.surface.cameras import photograph_cameras

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "tools"))
from lit_surface import in_cycles, in_threejs, view_of

Image = Float32[np.ndarray, "h w 3"]


def decibels(image: Image, other: Image, mask: np.ndarray) -> str:
    """PSNR of the whole picture and of the mask."""
    errors = (np.clip(image, 0, 1).astype(np.float64) - np.clip(other, 0, 1)) ** 2
    return " / ".join(f"{-10 * np.log10(part.mean()):.1f}" for part in (errors, errors[mask]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("glb", type=Path)
    parser.add_argument("--on", type=Path, required=True)
    parser.add_argument("--environment", type=Path, action="append", default=[])
    parser.add_argument("--views", type=int, default=2)
    parser.add_argument("--max-side", type=int, default=400)
    parser.add_argument("--samples", type=int, default=128)
    parser.add_argument("--output", type=Path, help="folder for the pictures")
    asked = parser.parse_args()

    config = read_config(asked.run / CONFIG)
    gaussians = read_scene(asked.run / SCENE)[0]
    frame = environment_frame(np.array(config.train.materials.up_world, np.float64))
    trace, extent = config.train.trace, run_viewpoints(asked.run).extent
    by = {
        "path": PathRelighter(
            gaussians, trace, Integrator(samples=asked.samples, max_depth=6, roulette_depth=6)
        ),
        "split sum": SplitSumRelighter(gaussians, trace, config.train.materials, extent_world=extent),
    }
    places = [path for path in (asked.on / TRUTH, asked.on.parent / TRUTH) if path.is_file()]
    truth = read_truth(places[0]) if places else None
    photographs = load_scene(asked.on, max_side=asked.max_side, least_views=1, for_training=False)
    names = [view.name for view in photographs.views]
    wanted = [name for name in (truth.content.relight.views if truth else names) if name in names]
    wanted = wanted[:: max(1, len(wanted) // asked.views)][: asked.views]

    for light in (asked.run / ENVIRONMENT, *asked.environment):
        environment = EnvironmentMap(read_environment(light), frame)
        for relighter in by.values():
            relighter.put(environment)
        for name in wanted:
            number = names.index(name)
            camera = photograph_cameras(photographs, np.array([number]), asked.max_side)[0]
            view = view_of(camera, frame)
            pictures: dict[str, Image] = {}
            took: dict[str, float] = {}

            def timed(label: str, make: Callable[[], Image]) -> None:
                start = time.perf_counter()
                pictures[label] = np.clip(make(), 0, 1)  # noqa: B023
                took[label] = time.perf_counter() - start  # noqa: B023

            relit = {label: relighter.render(camera.rays()) for label, relighter in by.items()}
            for label, picture in relit.items():
                pictures[label] = np.clip(picture.over(np.zeros(3, np.float32)), 0, 1)
            timed("Cycles", lambda: in_cycles(asked.glb, light, view, asked.samples))  # noqa: B023
            timed("three.js", lambda: in_threejs(asked.glb, light, view))  # noqa: B023
            mask = relit["path"].coverage > 0.5
            line = [
                f"Cycles to path {decibels(pictures['Cycles'], pictures['path'], mask)}",
                f"three.js to split sum {decibels(pictures['three.js'], pictures['split sum'], mask)}",
                f"path to split sum {decibels(pictures['path'], pictures['split sum'], mask)}",
            ]
            true = true_picture(truth, photographs, light, asked.run, number, name, asked.max_side)
            if true is not None:
                line += [f"{key} to truth {decibels(image, true, mask)}" for key, image in pictures.items()]
                pictures["truth"] = true
            line += [f"{key} {seconds:.0f} s" for key, seconds in took.items()]
            print(f"{light.stem}, {name}: " + "; ".join(line), flush=True)
            if asked.output:
                strip = np.concatenate(list(pictures.values()), axis=1)
                write_png(asked.output / f"{light.stem}_{Path(name).stem}.png", strip)


def true_picture(
    truth: Truth | None, photographs: Dataset, light: Path, run: Path, number: int, name: str, side: int
) -> Image | None:
    """What is known of a view under a light, over black."""
    if light == run / ENVIRONMENT:
        image = read_image(photographs.views[number].image_path)
        return image[..., :3] * image[..., 3:] if image.shape[2] == 4 else image[..., :3]
    for folder, path in truth.relit if truth else ():
        if path.stem == light.stem:
            return truth.relit_picture(folder, name, side)[..., :3]
    return None


if __name__ == "__main__":
    main()
