"""``octasplat view``: the viewer of a file, served by the command."""

import json
import re
import signal
import socket
import subprocess
import sys
import tracemalloc
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import octasplat as osp
from octasplat.service.web.scene_server import SceneServer, ViewedScene
from tests.support.web_harness import Browse

COUNT = 300


@pytest.fixture(scope="module")
def scene() -> osp.Scene:
    """A wall of bright Gaussians."""
    random = np.random.default_rng(5)
    means = np.concatenate([random.uniform(-1, 1, (COUNT, 2)), np.zeros((COUNT, 1))], axis=1)
    return osp.Scene.from_arrays(
        means, np.tile([1.0, 0, -1, 0], (COUNT, 1)), np.full((COUNT, 2), 0.1), np.full(COUNT, 0.9),
        np.full((COUNT, 1, 3), 1.5),
    )  # fmt: skip


@contextmanager
def viewed(path: Path, *options: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run the command; yields the process and the address that it names."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell may have set to be ignored
    command = [sys.executable, "-m", "octasplat", "view", str(path), "--no-open", *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None and process.stderr is not None
        text = process.stdout.readline()
        found = re.search(r"http://127\.0\.0\.1:\d+/\S+/", text)
        assert found is not None, text + process.stderr.read()
        yield process, found[0]
    finally:
        process.kill()
        process.communicate()


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["scene.ply", "scene.spz", "octagons.glb", "scene.splats.glb"])
def test_view_serves_files_of_any_format_until_interrupted(
    scene: osp.Scene, tmp_path: Path, name: str
) -> None:
    osp.save(scene, tmp_path / name)
    with viewed(tmp_path / name) as (process, url):
        page = urllib.request.urlopen(url, timeout=30).read().decode()
        assert f"<h1>{name}</h1>" in page
        ply = urllib.request.urlopen(f"{url}scene.ply", timeout=30).read()
        (tmp_path / "again.ply").write_bytes(ply)
        assert len(osp.load(tmp_path / "again.ply")) == COUNT
        assert json.loads(urllib.request.urlopen(f"{url}cameras.json", timeout=30).read()) == {"views": []}
        process.send_signal(signal.SIGINT)
        _, complaints = process.communicate(timeout=60)
        assert process.returncode == 0 and "Error" not in complaints and "Traceback" not in complaints


def test_large_scene_is_sent_in_little_memory(tmp_path: Path) -> None:
    large, size_bytes = tmp_path / "scene.ply", 256 << 20
    with large.open("wb") as file:
        file.truncate(size_bytes)
    server = SceneServer(ViewedScene("large", large, {"views": []}, None, "black"))
    received = 0
    tracemalloc.start()
    try:
        with urllib.request.urlopen(f"{server.url}scene.ply", timeout=30) as answer:
            assert int(answer.headers["Content-Length"]) == size_bytes
            while piece := answer.read(1 << 20):
                received += len(piece)
        assert received == size_bytes and tracemalloc.get_traced_memory()[1] < 16 << 20
    finally:
        tracemalloc.stop()
        server.close()


@pytest.mark.exhaustive
def test_view_names_a_taken_port(scene: osp.Scene, tmp_path: Path) -> None:
    osp.save(scene, tmp_path / "scene.ply")
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = str(other.getsockname()[1])
        command = [sys.executable, "-m", "octasplat", "view", str(tmp_path / "scene.ply"), "--port", port]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1 and f"Error: port {port} cannot be used" in done.stderr


@pytest.mark.tools
@pytest.mark.heavy
def test_browser_draws_what_the_command_serves(scene: osp.Scene, tmp_path: Path, browse: Browse) -> None:
    osp.save(scene, tmp_path / "wall.spz")
    with viewed(tmp_path / "wall.spz") as (_, url):
        found = browse("scene", url)
    assert found["heading"] == "wall.spz" and found["count"] == f"{COUNT} Gaussians"
    assert found["complaints"] == [] and found["shown"]["deviation"] > 2
