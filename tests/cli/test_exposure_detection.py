"""Photographs whose exposure changes are noticed, that is learnt, and held-out ones are exposed alike."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image


@pytest.fixture(scope="module")
def uneven(scene, tmp_path_factory):
    """The generated photographs, each darker or brighter than the one before it, little by little."""
    root = tmp_path_factory.mktemp("uneven") / "scene"
    shutil.copytree(scene, root)
    for number, path in enumerate(sorted((root / "images").iterdir())):
        shown = np.asarray(Image.open(path), np.float64) * (0.5 + 0.06 * number)
        Image.fromarray(np.clip(np.rint(shown), 0, 255).astype(np.uint8)).save(path)
    return root


def test_uneven_exposure_warns_and_corrects_held_out_views(uneven, octasplat, tiny, tmp_path):
    fixed = ("--set", "exposure=false")
    result = octasplat("reconstruct", uneven, "-o", tmp_path / "fixed", *tiny, *fixed, "--exports", "")
    assert result.exit_code == 0 and "exposure" not in result.output.replace(str(tmp_path), ""), result.output
    assert "exposures" not in json.loads((tmp_path / "fixed" / "training.json").read_text())
    quick = ("--set", "lr.exposure=0.03")
    result = octasplat("reconstruct", uneven, "-o", tmp_path / "learnt", *tiny, *quick, "--exports", "")
    assert result.exit_code == 0 and "exposure=false" in result.output, result.output
    exposures = json.loads((tmp_path / "learnt" / "training.json").read_text())["exposures"]
    names = sorted(exposures)
    brightness = {name: float(np.mean(exposures[name]["log_gains"])) for name in names}
    held_out = json.loads((tmp_path / "learnt" / "held_out.json").read_text())
    inner = [name for name in held_out if name not in (names[0], names[-1])]
    assert inner and all(brightness[name] != 0 for name in inner)
    trained = [brightness[name] for name in names if name not in held_out]
    assert trained[0] < trained[-1]
    metrics = json.loads((tmp_path / "learnt" / "metrics.json").read_text())
    assert "beside them" in metrics["exposure"]


def test_even_photographs_are_not(run):
    assert "exposure" not in run.stdout
