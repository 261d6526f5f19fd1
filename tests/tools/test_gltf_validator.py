from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from engine.export.options import ExportOptions
from engine.export.registry import export_scene
from engine.gaussians.model import FlatGaussians

pytestmark = pytest.mark.tools


@pytest.mark.parametrize("ids", [True, False])
@pytest.mark.parametrize("count", [1, 3, 5001])
def test_the_khronos_validator_finds_nothing_wrong(
    validate_glb: Callable[[Path], dict[str, Any]], tmp_path: Path, count: int, ids: bool
) -> None:
    random = np.random.default_rng(0)

    def normal(*shape: int) -> np.ndarray:
        return random.standard_normal(shape, dtype=np.float32)

    scene = FlatGaussians(
        normal(count, 3), normal(count, 4), normal(count, 2) - 3, normal(count) + 3, normal(count, 1, 3)
    )
    export_scene(scene, tmp_path / "scene.glb", ExportOptions(ids=ids, texture_size=64))
    report = validate_glb(tmp_path / "scene.glb")
    issues = report["issues"]
    assert (issues["numErrors"], issues["numWarnings"], issues["numInfos"], issues["numHints"]) == (
        0,
        0,
        0,
        0,
    ), issues
    info = report["info"]
    assert info["totalTriangleCount"] == 6 * count
    assert info["totalVertexCount"] == 8 * count
