"""The client as a distribution of its own, with nothing beside it but the packages that it asks for."""

import re
import tomllib
from pathlib import Path

import pytest

from tests.support.environments import (
    ROOT,
    Environment,
    build_distribution,
    copy_project,
    empty_environment,
    link_packages,
    run,
)

PROJECT = tomllib.loads((ROOT / "packages" / "client" / "pyproject.toml").read_text())["project"]
HEAVY = {"torch", "numba", "numpy", "fastapi", "scipy", "psycopg", "embreex", "pycolmap"}
TALK = """
import sys, threading
from http.server import BaseHTTPRequestHandler, HTTPServer
import json
import octasplat as osp

class Service(BaseHTTPRequestHandler):
    def do_GET(self):
        assert self.headers["Authorization"] == "Bearer a-token"
        job = {"id": "4711", "kind": "reconstruct", "label": None, "state": "succeeded", "psnr": 31.5}
        body = json.dumps({"jobs": [job], "next": None}).encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)
    def log_message(self, *_):
        pass

server = HTTPServer(("127.0.0.1", 0), Service)
threading.Thread(target=server.serve_forever, daemon=True).start()
with osp.Client(f"http://127.0.0.1:{server.server_port}", "a-token") as client:
    (job,) = client.jobs()
    print(job, job.psnr)
server.shutdown()
try:
    osp.load
except ImportError as error:
    print(error)
"""


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Environment:
    """An environment with the client alone."""
    folder = tmp_path_factory.mktemp("client")
    project = copy_project(folder / "project") / "packages" / "client"
    environment = empty_environment(folder / "environment")
    linked = link_packages(environment, PROJECT["dependencies"])
    assert not linked & HEAVY
    environment.install(build_distribution(project, "wheel", folder), cwd=folder)
    assert {name for name in environment.own_files("octasplat_client") if "dist-info" not in name} == {
        "octasplat"
    }
    return environment


def test_client_talks_to_a_service_with_the_light_packages_only(client: Environment, tmp_path: Path) -> None:
    talked, refused = run((client.python, "-c", TALK), tmp_path).splitlines()
    assert talked == "Job('4711', reconstruct, succeeded) 31.5"
    assert re.fullmatch(r"octasplat.load needs '\w+', which is not installed; install octasplat, .*", refused)


def test_client_modules_are_importable(client: Environment, tmp_path: Path) -> None:
    code = (
        "import importlib, pkgutil, octasplat.workers.client as package, octasplat.client\n"
        "for module in pkgutil.iter_modules(package.__path__):\n"
        "    importlib.import_module(f'octasplat.workers.client.{module.name}')\n"
    )
    assert run((client.python, "-c", code), tmp_path) == ""


def test_client_requirements_match_project() -> None:
    whole = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert set(PROJECT["dependencies"]) <= set(whole["dependencies"])
    assert PROJECT["requires-python"] == whole["requires-python"]


def test_sdist_of_the_client_builds_the_same_wheel(tmp_path: Path) -> None:
    import tarfile
    import zipfile

    project = copy_project(tmp_path / "project") / "packages" / "client"
    wheel = build_distribution(project, "wheel", tmp_path / "first")
    sdist = build_distribution(project, "sdist", tmp_path)
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path / "unpacked", filter="data")
    (unpacked,) = (tmp_path / "unpacked").iterdir()
    again = build_distribution(unpacked, "wheel", tmp_path / "second")
    assert zipfile.ZipFile(wheel).namelist() == zipfile.ZipFile(again).namelist()
