"""How near relit views come to the truth when a finished run is shaded as in training: seconds a picture.

python benchmarks/relit_by_split_sum.py OUT SCENE            # SCENE/truth.json, its views in SCENE/test
python benchmarks/relit_by_split_sum.py OUT SCENE --views 3  # of each map only so many

Prints PSNR raw and with one factor a channel for all maps together, and the same of each map.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from engine.colour import srgb_to_linear
from engine.config import read_config
from engine.evaluate.against_truth import relit_measures
from engine.evaluate.runs import finished_shading
from engine.evaluate.truth import read_truth
from engine.files.gaussian_ply import read_gaussian_ply
from engine.light.environment import read_environment
from engine.light.relighting import RelitImage
from engine.render.renderer import render_rays
from engine.run_folder import CONFIG, SCENE
from engine.scene import Dataset
from engine.trace.make import make_tracer
from engine.train.shading import deferred_of

BLACK = np.zeros(3, np.float32)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--views", type=int, default=10)
    options = parser.parse_args()
    config = read_config(options.run / CONFIG).train
    truth = read_truth(options.scene / "truth.json")
    dataset = Dataset.open(options.scene / "test", options.run / "cache" / "relit", test_every=0)
    gaussians, _ = read_gaussian_ply(options.run / SCENE)
    shading = finished_shading(options.run, config, dataset)
    deferred = deferred_of(shading)
    assert deferred is not None, "the run has no materials"
    tracer = make_tracer(config.trace)
    tracer.build(gaussians, shading.features(gaussians))
    by_name = {Path(view.name).name: index for index, view in enumerate(dataset.views)}
    chosen = truth.content.relight.views[:: max(1, len(truth.content.relight.views) // options.views)]
    pictures, wanted, names = [], [], []
    for folder, environment in truth.relit:
        deferred.light.put(read_environment(environment))
        for name in chosen:
            image = render_rays(tracer, dataset.view_rays(by_name[Path(name).name]), BLACK, shading)
            alpha = np.maximum(image.alpha, 1e-3)
            linear = srgb_to_linear(np.clip(image.rgb_srgb / alpha[..., None], 0, 1))
            pictures.append(RelitImage(linear, image.alpha))
            wanted.append(truth.relit_picture(folder, name, max(image.alpha.shape)))
            names.append((folder.name, name))
    print(json.dumps(relit_measures(pictures, wanted, names), indent=1))


if __name__ == "__main__":
    main()
