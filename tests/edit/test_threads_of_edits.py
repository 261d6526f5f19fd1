"""Edits take as many threads as they are given."""

from pathlib import Path

import numba
import pytest

import octasplat as osp
from octasplat.engine.core.threads import threads_in_use, use_threads
from octasplat.engine.files.gaussian_ply import write_gaussian_ply

CUBE = """v -9 -9 -9\nv 9 -9 -9\nv 9 9 -9\nv -9 9 -9\nv -9 -9 9\nv 9 -9 9\nv 9 9 9\nv -9 9 9
f 4 3 2 1\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8
"""


@pytest.fixture
def scene(make_gaussians, tmp_path) -> Path:
    write_gaussian_ply(make_gaussians(20), tmp_path / "scene.ply")
    return tmp_path / "scene.ply"


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one core has no fewer threads")
@pytest.mark.parametrize("verb", ["deform", "edit"])
def test_edit_takes_the_threads_that_it_is_given(scene, verb):
    cage, mesh, out = (scene.with_name(name) for name in ("cage.obj", "mesh.ply", "out.ply"))
    cage.write_text(CUBE)
    osp.export(scene, [mesh], format="mesh-ply")
    use_threads(0)
    for threads in (1, 2):
        if verb == "deform":
            osp.deform(scene, out, proxy=cage, deformed=[cage], method="mvc", threads=threads)
        else:
            osp.edit(scene, out, meshes=[mesh], threads=threads)
        assert threads_in_use() == threads
    use_threads(0)
