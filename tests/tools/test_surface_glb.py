from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octasplat.engine.files import write_surface
from octasplat.engine.geometry.triangle_mesh import TriangleMesh

pytestmark = pytest.mark.tools

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], np.int32)


@pytest.mark.parametrize("textured", [False, True])
def test_surface_glb_passes_khronos_validator(
    validate_glb: Callable[[Path], dict[str, Any]], tmp_path: Path, textured: bool
) -> None:
    if textured:
        image = np.arange(64 * 64 * 3, dtype=np.uint8).reshape(64, 64, 3)
        mesh = TriangleMesh(VERTICES, FACES, uv=VERTICES[:, :2].copy(), texture_srgb=image)
    else:
        mesh = TriangleMesh(VERTICES, FACES, rgb_srgb=np.full((4, 3), 0.5, np.float32))
    write_surface(mesh, tmp_path / "surface.glb")
    report = validate_glb(tmp_path / "surface.glb")
    issues = report["issues"]
    counts = [issues[name] for name in ("numErrors", "numWarnings", "numInfos", "numHints")]
    assert counts == [0, 0, 0, 0], issues
    assert report["info"]["totalTriangleCount"] == 4
