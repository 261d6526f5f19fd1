"""A render or relight goes on with its own images only, whichever of its cameras are others."""

import json
import shutil
from pathlib import Path
from typing import Any

import pycolmap
import pytest

from octasplat.engine.core.errors import CancelledError, ConfigError
from octasplat.engine.core.events import Event, ImagesSaved
from octasplat.engine.operations import relight, render
from tests.support.daily import some_daily


def stopped_after_one(verb: Any, request: Any) -> None:
    """Do a request until the first image is done."""
    kept: list[Event] = []

    def hear(event: Event) -> None:
        if isinstance(event, ImagesSaved):
            kept.append(event)

    with pytest.raises(CancelledError):
        verb.run(request, progress=hear, should_stop=lambda: bool(kept), threads=1)


def goes_on(verb: Any, request: Any) -> bool:
    try:
        verb.run(request.model_copy(update={"resume": True}), threads=1)
    except ConfigError as error:
        assert "images of another render" in str(error)
        return False
    return True


def request_of(verb: str, run: Path, output: Path, **given: Any) -> tuple[Any, Any]:
    if verb == "render":
        return render, render.RenderRequest(source=run, output=output, **given)
    light = {"environments": (run / "environment.hdr",), "samples": 1}
    return relight, relight.RelightRequest(source=run, output=output, **light, **given)


@pytest.mark.exhaustive
@pytest.mark.parametrize("verb", ["render", "relight"])
def test_changed_middle_photograph_starts_new_render(shiny_run, tmp_path, verb):
    names = [view["name"] for view in json.loads((shiny_run / "views.json").read_text())["views"]]
    pattern = tmp_path / "%04d.png"
    module, one = request_of(verb, shiny_run, pattern, photographs=tuple(names[k] for k in (0, 1, 3)))
    _, other = request_of(verb, shiny_run, pattern, photographs=tuple(names[k] for k in (0, 2, 3)))
    stopped_after_one(module, one)
    assert not goes_on(module, other)
    assert goes_on(module, one)


@pytest.mark.exhaustive
@pytest.mark.parametrize("verb", some_daily(["render", "relight"], {"relight"}))
def test_changed_middle_camera_starts_new_render(shiny_run, tmp_path, verb):
    def path(middle: float) -> dict[str, Any]:
        poses = [[[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, -4], [0, 0, 0, 1]] for x in (0, middle, 1)]
        frames = [{"camera_to_world": pose, "fov_y_degrees": 50} for pose in poses]
        return {"width": 32, "height": 24, "frames": frames}

    module, one = request_of(verb, shiny_run, tmp_path / "out", camera_path=path(0.5))
    _, other = request_of(verb, shiny_run, tmp_path / "out", camera_path=path(0.6))
    stopped_after_one(module, one)
    assert not goes_on(module, other)
    assert goes_on(module, one)


@pytest.mark.exhaustive
def test_photographs_of_another_folder_are_another_relight(run, shiny_run, tmp_path):
    moved = tmp_path / "moved"
    shutil.copytree(run.scene, moved)
    model = pycolmap.Reconstruction(str(moved / "sparse/0"))
    middle = sorted(model.images.values(), key=lambda image: image.name)[3]
    rotation = middle.cam_from_world().rotation
    middle.frame.rig_from_world = pycolmap.Rigid3d(rotation, middle.cam_from_world().translation * 1.1)
    model.write_binary(str(moved / "sparse/0"))
    module, one = request_of("relight", shiny_run, tmp_path / "out", other_dataset=run.scene)
    _, other = request_of("relight", shiny_run, tmp_path / "out", other_dataset=moved)
    stopped_after_one(module, one)
    assert not goes_on(module, other)
    assert goes_on(module, one)
