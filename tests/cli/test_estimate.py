"""``octasplat estimate``: what a reconstruction takes, by the sizes of the photographs."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.dataset.image_sizes import ImageSizes
from octasplat.engine.operations.cost_model import estimate_reconstruction
from octasplat.engine.operations.estimate import EstimateRequest, run
from octasplat.engine.operations.reconstruct import ReconstructOptions
from octasplat.engine.render.image_files import write_png


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    folder = tmp_path / "scene" / "images"
    folder.mkdir(parents=True)
    for number in range(10):
        write_png(folder / f"{number}.png", np.zeros((30, 40, 3), np.float32))
    return folder.parent


def test_estimate_counts_photographs_and_follows_the_options(photographs: Path) -> None:
    fast, standard = (
        run(EstimateRequest(source=photographs, preset=name, cores=2)) for name in ("fast", "standard")
    )
    assert fast.photographs == (ImageSizes(40, 30, 10),)
    assert fast.cores == 2 and fast.finds_poses and "find the poses" in fast.text
    assert 0 < fast.poses_seconds < fast.seconds
    assert fast.cpu_seconds < standard.cpu_seconds
    longer = run(EstimateRequest(source=photographs, preset="fast", cores=2, set=("iterations=5000",)))
    assert longer.cpu_seconds > fast.cpu_seconds


def test_estimate_of_poses_grows_with_pairs_until_those_that_look_alike_are_chosen() -> None:
    config = ReconstructOptions(poses="auto").config()
    seconds = [
        estimate_reconstruction(config, [ImageSizes(960, 640, count)], 1).poses_seconds
        for count in (20, 40, 200, 400)
    ]
    assert 2.5 < seconds[1] / seconds[0] < 4  # every pair is matched
    assert 1.8 < seconds[3] / seconds[2] < 2.5  # so many pairs for each photograph
    given = estimate_reconstruction(
        config.model_copy(update={"poses": "given"}), [ImageSizes(960, 640, 20)], 1
    )
    assert given.poses_seconds == 0 and "poses" not in given.text


def test_estimate_command_prints_sentence(octasplat, photographs: Path) -> None:
    done = octasplat("estimate", photographs, "--preset", "fast", "--cores", 4)
    assert done.exit_code == 0, done.stderr
    assert done.stdout.startswith("10 photographs: about ") and "on 4 cores" in done.stdout


def test_folder_without_photographs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=rf"{tmp_path.name}: There are 0 photographs"):
        run(EstimateRequest(source=tmp_path))
