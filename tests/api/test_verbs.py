"""The functions of verbs are those that their requests say."""

import inspect
from pathlib import Path

import numpy as np
import pytest
from write_verbs import PYTHON_NAMES, VERBS, source

import octasplat as osp
import octasplat.verbs
from octasplat.engine.errors import ConfigError
from octasplat.engine.operations.base import build
from octasplat.engine.operations.registry import operation, operation_names


def test_verbs_are_written_from_the_requests() -> None:
    assert VERBS.read_text(encoding="utf-8") == source(), "run python tests/api/write_verbs.py"


@pytest.mark.parametrize("name", operation_names())
def test_every_operation_is_a_function_of_the_package(name: str) -> None:
    function = getattr(osp, PYTHON_NAMES.get(name, name))
    if name != "render":  # which also takes a scene and a camera
        assert function is getattr(octasplat.verbs, PYTHON_NAMES.get(name, name))
    parameters = inspect.signature(getattr(octasplat.verbs, PYTHON_NAMES.get(name, name))).parameters
    fields = operation(name).request.model_fields
    assert set(fields) <= set(parameters) <= {*fields, "progress", "should_stop", "threads", "on_step"}


def test_refused_values_have_the_sentence_of_the_request(scene_file: Path, tmp_path: Path) -> None:
    values = {"source": scene_file, "output": tmp_path / "a.ply", "where": "colour > 3 and"}
    with pytest.raises(ConfigError) as expected:
        build(operation("crop").request, values)
    with pytest.raises(ConfigError) as found:
        osp.crop(scene_file, tmp_path / "a.ply", where="colour > 3 and")
    assert str(found.value) == str(expected.value)


def test_arrays_and_strings_are_taken_where_numbers_and_paths_are(scene_file: Path, tmp_path: Path) -> None:
    box = np.array([-2.0, -2, -2, 2, 2, 0])
    assert osp.crop(str(scene_file), str(tmp_path / "half.ply"), box=box).kept == 600
