"""The viewer of one scene without the service."""

import http.client
import json
import socket
import tempfile
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urljoin, urlsplit

import numpy as np
import pytest

import octasplat as osp
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.shading.material_settings import MaterialSettings
from octasplat.engine.shading.recipes import material_shading
from tests.support.light_scenes import shiny_ball
from tests.support.web_harness import Browse


@pytest.fixture
def scene() -> osp.Scene:
    """A wall of bright Gaussians."""
    count = 400
    random = np.random.default_rng(3)
    means = np.concatenate([random.uniform(-1, 1, (count, 2)), np.zeros((count, 1))], axis=1)
    return osp.Scene.from_arrays(
        means, np.tile([1.0, 0, -1, 0], (count, 1)), np.full((count, 2), 0.1), np.full(count, 0.9),
        np.full((count, 1, 3), 1.5),
    )  # fmt: skip


@pytest.fixture
def viewer(scene: osp.Scene) -> Iterator[osp.Viewer]:
    with osp.view(scene, open_browser=False, background="white") as found:
        yield found


def get(url: str, path: str, host: str | None = None) -> tuple[int, str, bytes]:
    """Return the answer to a path; a relative one is of the page."""
    parts = urlsplit(urljoin(url, path))
    connection = http.client.HTTPConnection(parts.hostname or "", parts.port)
    connection.request("GET", parts.path, headers={} if host is None else {"Host": host})
    answer = connection.getresponse()
    return answer.status, answer.headers.get("Content-Type", ""), answer.read()


def test_page_scene_and_scripts_are_served(viewer: osp.Viewer, scene: osp.Scene, tmp_path: Path) -> None:
    status, kind, page = get(viewer.url, "")
    assert (status, kind) == (200, "text/html; charset=utf-8")
    assert f'data-scene="{urlsplit(viewer.url).path}scene.ply"'.encode() in page
    assert b'data-background="white"' in page
    _, _, ply = get(viewer.url, "scene.ply")
    (tmp_path / "again.ply").write_bytes(ply)
    np.testing.assert_array_equal(osp.load(tmp_path / "again.ply").means, scene.means)
    assert get(viewer.url, "/static/viewer/page.js")[:2] == (200, "text/javascript")
    assert json.loads(get(viewer.url, "cameras.json")[2]) == {"views": []}


@pytest.mark.parametrize(
    "path",
    ["/static/../templates/base.html", "/static/%2e%2e/pages.py", "/etc/passwd", "/x", "/", "/scene.ply"],
)
def test_scene_server_other_paths_are_404(viewer: osp.Viewer, path: str) -> None:
    assert get(viewer.url, path)[0] == 404


def test_scene_server_refuses_foreign_origin(viewer: osp.Viewer) -> None:
    assert get(viewer.url, "scene.ply", host="rebound.example")[0] == 403


def lit_scene(recipe: str = "split_sum") -> osp.Scene:
    """A white ball in the red light that it was learnt in, whose harmonics are blue."""
    settings = MaterialSettings.model_validate(
        {"learn": True, "recipe": recipe, "environment_height": 16, "up_world": [0.0, -1.0, 0.0]}
    )
    gaussians = shiny_ball(1500, 1.0, albedo=(1.0, 1.0, 1.0), metallic=0.0, roughness=1.0)
    gaussians.sh[:, 0] = np.array([-1.7, -1.7, 0.5])
    shading = material_shading(settings.recipe)(settings, extent_world=4.0)
    shading.light.set_radiance(np.tile(np.float32([0.8, 0.1, 0.1]), (16, 32, 1)))
    return osp.Scene(gaussians, materials=shading)


def test_materials_are_served_in_the_light_that_was_learnt() -> None:
    with osp.view(lit_scene(), open_browser=False) as viewer:
        page = get(viewer.url, "")[2].decode()
        assert f'data-light="{urlsplit(viewer.url).path}light.hdr"' in page
        assert 'data-up="[0.0, -1.0, 0.0]"' in page
        status, kind, light = get(viewer.url, "light.hdr")
        assert (status, kind) == (200, "image/vnd.radiance") and light.startswith(b"#?")
    with osp.view(lit_scene(), open_browser=False, shading="harmonics") as viewer:
        assert b"data-light" not in get(viewer.url, "")[2] and get(viewer.url, "light.hdr")[0] == 404


def test_materials_that_cannot_be_shown_are_not(scene: osp.Scene) -> None:
    for other, words in (
        (scene, "holds no light"),
        (lit_scene("near_field"), "light of the photographs"),
        (lit_scene("ref_gaussian"), "from the harmonics"),
    ):
        with osp.view(other, open_browser=False) as viewer:
            assert b"data-light" not in get(viewer.url, "")[2]
        with pytest.raises(ConfigError, match=words):
            osp.view(other, open_browser=False, shading="materials")


@pytest.mark.tools
@pytest.mark.heavy
def test_browser_shows_materials_at_first_and_harmonics_when_asked(browse: Browse) -> None:
    with osp.view(lit_scene(), open_browser=False) as viewer:
        found = browse("materials", viewer.url, lit=True)
    assert found["lit"] == ["learnt", "none", "learnt"] and found["complaints"] == []
    assert found["pressed"] == ["true", "false", "true"]
    materials, harmonics, again = found["looks"]
    assert materials == pytest.approx(again, abs=0.1) and abs(materials - harmonics) > 5
    with osp.view(lit_scene(), open_browser=False, shading="harmonics") as viewer:
        other = browse("materials", viewer.url, lit=False)
    assert other["pressed"] == [False] and other["looks"] == [pytest.approx(harmonics, abs=0.1)]


def test_scene_server_addresses_differ(viewer: osp.Viewer, scene: osp.Scene) -> None:
    with osp.view(scene, open_browser=False) as other:
        secrets = {len(urlsplit(found.url).path) for found in (viewer, other)}
        assert secrets == {24}  # 128 random bits
        assert urlsplit(viewer.url).path != urlsplit(other.url).path


def test_scene_server_closed_refuses_connections(scene: osp.Scene) -> None:
    viewer = osp.view(scene, open_browser=False)
    url = viewer.url
    viewer.close()
    viewer.close()
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(url, timeout=5)


@pytest.mark.tools
@pytest.mark.heavy
def test_browser_draws_the_scene(viewer: osp.Viewer, browse: Browse) -> None:
    found = browse("scene", viewer.url)
    assert found["heading"] == "Scene" and found["count"] == "400 Gaussians"
    assert found["complaints"] == [] and found["shown"]["deviation"] > 2


def test_taken_port_leaves_no_folder(
    scene: osp.Scene, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        # The error holds the frames, and the folder with them.
        with pytest.raises(osp.OctasplatError, match=f"port {port} cannot be used .*in use") as failure:
            osp.view(scene, open_browser=False, port=port)
        assert isinstance(failure.value.__cause__, OSError)
        assert not list(tmp_path.glob("octasplat-view-*"))
