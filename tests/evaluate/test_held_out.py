"""The held-out views of a dataset, measured and written."""

import json
import shutil

import numpy as np

from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.evaluate import held_out
from octasplat.engine.evaluate.held_out import evaluate_held_out
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.image_files import read_image, write_png
from octasplat.engine.shading.plain import PLAIN_SHADING
from octasplat.engine.trace.protocol import TraceSettings


def a_gray_gaussian():
    return FlatGaussians(
        np.zeros((1, 3), np.float32),
        np.array([[1, 0, 0, 0]], np.float32),
        np.zeros((1, 2), np.float32),
        np.zeros(1, np.float32),
        np.zeros((1, 1, 3), np.float32),
    )


def evaluate(data, output, threads):
    evaluate_held_out(
        data,
        a_gray_gaussian(),
        output,
        settings=TraceSettings(),
        shading=PLAIN_SHADING,
        background="black",
        run={},
        config={},
        threads=threads,
        progress=lambda _event: None,
    )


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
    names = ["a.png", "a.tif"]
    data = Dataset.open(root, tmp_path / "cache", held_out=names)
    output = tmp_path / "out"
    evaluate(data, output, threads=1)
    assert sorted(path.name for path in (output / "renders").iterdir()) == ["a.png.png", "a.tif.png"]
    assert sorted(json.loads((output / "metrics.json").read_text())["views"]) == names


def test_large_views_are_measured_one_after_the_other_on_any_number_of_threads(tmp_path, monkeypatch):
    """Each view takes some hundred bytes a pixel, while it is measured and while it waits for its turn."""
    config = SyntheticDatasetConfig(views=6, width_px=40, height_px=30, samples_per_side=1, points=100)
    write_synthetic_dataset(tmp_path / "scene", config)
    data = Dataset.open(tmp_path / "scene", tmp_path / "cache", test_every=2)
    rendered, most = 0, 0
    render, measure = held_out.render_filtered, held_out.measure_view

    def count_rendered(*arguments):
        nonlocal rendered, most
        rendered += 1
        most = max(most, rendered)
        return render(*arguments)

    def count_measured(*arguments):
        nonlocal rendered
        rendered -= 1
        return measure(*arguments)

    monkeypatch.setattr(held_out, "render_filtered", count_rendered)
    monkeypatch.setattr(held_out, "measure_view", count_measured)
    monkeypatch.setattr(held_out, "MAX_PIXELS_AT_ONCE", 2 * 40 * 30 - 1)
    evaluate(data, tmp_path / "out", threads=9)
    assert most == 1 and rendered == 0


def test_views_have_the_same_results_on_any_number_of_threads(tmp_path):
    config = SyntheticDatasetConfig(views=12, width_px=72, height_px=54, samples_per_side=1, points=100)
    write_synthetic_dataset(tmp_path / "scene", config)
    data = Dataset.open(tmp_path / "scene", tmp_path / "cache", test_every=2)
    results = []
    for threads in (1, 3, 9):
        output = tmp_path / str(threads)
        evaluate(data, output, threads)
        files = sorted(path for path in output.rglob("*") if path.is_file())
        results.append({path.relative_to(output).as_posix(): path.read_bytes() for path in files})
    assert sum(name.startswith("renders/") for name in results[0]) == 6
    assert list(json.loads(results[0]["metrics.json"])["views"]) == [
        data.views[index].name for index in data.test_indices
    ]
    assert results[0] == results[1] == results[2]
