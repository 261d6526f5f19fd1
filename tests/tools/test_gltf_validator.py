from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octasplat.engine.files import ExportOptions, export_scene
from octasplat.engine.files.export_options import ExportCamera
from octasplat.engine.gaussians.materials import MATERIAL_WIDTHS
from octasplat.engine.gaussians.model import FlatGaussians
from tests.support.daily import some_daily

pytestmark = pytest.mark.tools
CAMERA = ExportCamera(
    name="a.jpg",
    position_world=(1, 2, 3),
    rotation_xyzw=(0, 0, 0, 1),
    yfov_rad=0.8,
    aspect=1.5,
    near_world=0.01,
)


@pytest.mark.parametrize(
    "settings",
    [{}, {"ids": False}, {"opaque": True}, {"chunks": 1}, {"light_up": (0, 0, 1)}, {"camera": CAMERA}],
)
@pytest.mark.parametrize("count", some_daily([1, 3, 5001], [3]))
def test_octagon_glb_passes_khronos_validator(
    validate_glb: Callable[[Path], dict[str, Any]], tmp_path: Path, count: int, settings: dict[str, Any]
) -> None:
    random = np.random.default_rng(0)

    def normal(*shape: int) -> np.ndarray:
        return random.standard_normal(shape, dtype=np.float32)

    scene = FlatGaussians(
        normal(count, 3), normal(count, 4), normal(count, 2) - 3, normal(count) + 5, normal(count, 1, 3)
    )
    if "light_up" in settings:
        scene = scene.with_channels(
            {name: np.full((count, k), 0.5, np.float32) for name, k in MATERIAL_WIDTHS.items()}
        )
    export_scene(scene, tmp_path / "scene.glb", ExportOptions(falloff_texture_size=64, **settings))
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


KNOWN_FALSE_ERRORS = {"MESH_PRIMITIVE_INVALID_ATTRIBUTE"}
"""The validator does not know the attribute names of KHR_gaussian_splatting yet."""


@pytest.mark.parametrize("count", [1, 5001])
def test_splat_glb_is_valid_except_unknown_extension(
    validate_glb: Callable[[Path], dict[str, Any]], tmp_path: Path, count: int
) -> None:
    random = np.random.default_rng(0)

    def normal(*shape: int) -> np.ndarray:
        return random.standard_normal(shape, dtype=np.float32)

    scene = FlatGaussians(
        normal(count, 3), normal(count, 4), normal(count, 2) - 3, normal(count) + 5, normal(count, 4, 3)
    )
    export_scene(scene, tmp_path / "scene.splats.glb")
    report = validate_glb(tmp_path / "scene.splats.glb")
    messages = report["issues"]["messages"]
    assert {message["code"] for message in messages if message["severity"] <= 1} <= KNOWN_FALSE_ERRORS
    # One for each of rotation, scale, opacity and the four coefficients.
    assert report["issues"]["numErrors"] == 7
    assert all("KHR_gaussian_splatting:" in m["pointer"] for m in messages if m["severity"] == 0), messages
    assert report["info"]["totalVertexCount"] == count
