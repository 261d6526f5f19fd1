"""The front end as its image has it, step by step in a bare environment: it starts and takes a scene."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from test_docker_files import ROOT, instructions

from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.workers.client.api import Api
from octasplat.workers.client.upload import upload_scene
from tests.support.service_harness import TOKEN

pytestmark = pytest.mark.heavy


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The environment after the COPY and RUN steps of the front end."""
    root = tmp_path_factory.mktemp("image")
    source, environment = root / "src", root / "octasplat"
    source.mkdir()
    subprocess.run([sys.executable, "-m", "venv", environment], check=True)
    path = f"{environment / 'bin'}{os.pathsep}{os.environ['PATH']}"
    for stage, word, rest in instructions():
        if stage != "front-end":
            continue
        if word == "COPY":
            *names, target = rest.split()
            for name in names:
                if (ROOT / name).is_dir():
                    ignore = shutil.ignore_patterns("__pycache__")
                    shutil.copytree(ROOT / name, source / target, ignore=ignore)
                else:
                    shutil.copy(ROOT / name, source / target)
        elif word == "RUN":
            step = {**os.environ, "PATH": path, "PIP_NO_COMPILE": "1"}
            done = subprocess.run(["bash", "-c", rest], cwd=source, env=step, capture_output=True, text=True)
            if done.returncode and "No matching distribution" in done.stderr:
                pytest.skip("packages cannot be installed here")
            assert done.returncode == 0, done.stderr[-3000:]
    return environment


@pytest.mark.exhaustive
def test_front_end_and_maintenance_run_without_torch(image: Path, conninfo: str, tmp_path: Path) -> None:
    python = image / "bin" / "python3"
    listed = subprocess.run([python, "-m", "pip", "list", "--format=json"], capture_output=True, check=True)
    names = {package["name"].lower() for package in json.loads(listed.stdout)}
    assert "octasplat" in names and not names & {"torch", "numba", "scipy"}
    environment = {
        "PATH": os.environ["PATH"],
        "DATABASE_URL": conninfo,
        "OCTASPLAT_DATA": str(tmp_path / "data"),
        "OCTASPLAT_FLOOR_BYTES": "0",
        "OCTASPLAT_PORT": "0",
        "OCTASPLAT_TOKEN": TOKEN,
    }
    front = [python, "-m", "octasplat", "api"]
    worker = [image / "bin" / "octasplat", "worker", "--queues", "", "--name", "maintenance"]
    log = tmp_path / "log"
    with log.open("w") as errors:
        api = subprocess.Popen(
            front, env=environment, cwd=tmp_path, stdout=subprocess.PIPE, stderr=errors, text=True
        )
        maintenance = subprocess.Popen(worker, env=environment, cwd=tmp_path, stderr=errors)
    try:
        assert api.stdout is not None
        address = api.stdout.readline().strip()
        assert address.startswith("http"), log.read_text()
        scene = tmp_path / "scene"
        write_synthetic_dataset(
            scene, SyntheticDatasetConfig(views=8, width_px=48, height_px=36, samples_per_side=1, points=500)
        )
        with Api(address, TOKEN) as client:
            dataset = upload_scene(client, scene)
            assert (dataset["state"], dataset["has_poses"], dataset["photographs"]) == ("committed", True, 8)
            assert client.get("/v1/options/reconstruct")["options"]["properties"]
            assert "<html" in client.request("GET", "/").text
            deadline = time.monotonic() + 120
            while not client.get("/v1/queues")["workers"]:
                assert time.monotonic() < deadline and maintenance.poll() is None, log.read_text()
                time.sleep(0.1)
    finally:
        maintenance.terminate()
        api.terminate()
        codes = maintenance.wait(60), api.wait(60)
        if api.stdout is not None:
            api.stdout.close()
    assert codes[0] == 0, log.read_text()
