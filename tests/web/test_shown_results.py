"""Which results of a job its page shows."""

import uuid

import pytest

from octasplat.service.web.results import viewable_mesh
from octasplat.workers.db.rows import Artifact


def artifact(name: str) -> Artifact:
    return Artifact(uuid.uuid4(), name, "0" * 64, 10, "application/octet-stream")


@pytest.mark.parametrize(
    ("names", "shown"),
    [
        (["surface.glb", "views.json"], "surface.glb"),
        (["a.glb", "mesh.glb"], "mesh.glb"),
        (["octagons.glb", "surface.glb", "viewer.glb"], "viewer.glb"),
        (["scene.splats.glb", "mesh.obj"], None),
        ([], None),
    ],
)
def test_shown_mesh_choice(names: list[str], shown: str | None) -> None:
    found = viewable_mesh([artifact(name) for name in names])
    assert (found.name if found else None) == shown
