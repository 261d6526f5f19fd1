"""The held-out views of a dataset, measured and written."""

import json
import shutil

import numpy as np

from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.evaluate.held_out import evaluate_held_out
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.image_files import read_image, write_png
from octasplat.engine.shading.plain import PLAIN_SHADING
from octasplat.engine.trace.protocol import TraceSettings


def test_same_stem_photographs_get_own_renders(tmp_path):
    import pycolmap

    root = tmp_path / "scene"
    config = SyntheticDatasetConfig(views=4, width_px=32, height_px=24, samples_per_side=1, points=100)
    write_synthetic_dataset(root, config)
    model = pycolmap.Reconstruction(root / "sparse" / "0")
    images = sorted(model.images.values(), key=lambda image: image.name)
    for image, name in zip(images, ("a.tif", "a.png", "b.png", "c.png"), strict=True):
        source = root / "images" / image.name
        write_png(root / "images" / "new.png", read_image(source)[..., :3])
        shutil.move(root / "images" / "new.png", root / "images" / name)
        source.unlink()
        image.name = name
    model.write(root / "sparse" / "0")
    held_out = ["a.png", "a.tif"]
    data = Dataset.open(root, tmp_path / "cache", held_out=held_out)
    grey = FlatGaussians(
        np.zeros((1, 3), np.float32),
        np.array([[1, 0, 0, 0]], np.float32),
        np.zeros((1, 2), np.float32),
        np.zeros(1, np.float32),
        np.zeros((1, 1, 3), np.float32),
    )
    output = tmp_path / "out"
    evaluate_held_out(
        data,
        grey,
        output,
        settings=TraceSettings(),
        shading=PLAIN_SHADING,
        background="black",
        run={},
        config={},
        threads=1,
        progress=lambda _event: None,
    )
    assert sorted(path.name for path in (output / "renders").iterdir()) == ["a.png.png", "a.tif.png"]
    assert sorted(json.loads((output / "metrics.json").read_text())["views"]) == held_out
