"""Clients that are generated from the OpenAPI document run the programs of docs/service.md on a service."""

import json
import os
import re
import subprocess
import sys
import venv
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from platformdirs import user_cache_dir

from octasplat.workers.postgres.embedded import EmbeddedPostgres
from tests.support.npm_packages import npm_folder
from tests.support.postgres_fixtures import copied_database
from tests.support.service_harness import TOKEN, api_environment
from tests.support.tiny_dataset import make_tiny_dataset

pytestmark = pytest.mark.heavy

ROOT = Path(__file__).parents[2]
PYTHON_GENERATOR = "openapi-python-client==0.29.1"
SECONDS = 300


def program(language: str) -> str:
    """The program in that language of the document, with a shorter training."""
    text = (ROOT / "docs" / "service.md").read_text(encoding="utf-8").partition("## Generated clients")[2]
    found = re.search(rf"```{language}\n(.*?)```", text, re.DOTALL)
    assert found is not None
    shorter, count = re.subn(r"(iterations\"?: )200\b", r"\g<1>40", found[1])
    assert count == 1
    return shorter


def run(*command: str | Path, folder: Path, **environment: str) -> "subprocess.CompletedProcess[str]":
    done = subprocess.run(
        [str(part) for part in command], cwd=folder, env={**os.environ, **environment}, capture_output=True,
        text=True, timeout=SECONDS, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_dataset(tmp_path_factory)


@pytest.fixture(scope="module")
def server(
    postgres: EmbeddedPostgres, template: str, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[str]:
    """The address of a front end that has a worker."""
    with copied_database(postgres, template) as conninfo:
        yield from serve(conninfo, tmp_path_factory.mktemp("server"))


def serve(conninfo: str, data: Path) -> Iterator[str]:
    given = {
        **api_environment(conninfo, data), "OCTASPLAT_STORAGE": str(data / "store"),
        "OCTASPLAT_WORK": str(data / "work"), "OCTASPLAT_THREADS": "1", "OMP_NUM_THREADS": "1",
        "OCTASPLAT_POLL_SECONDS": "0.15",
    }  # fmt: skip
    command = [sys.executable, "-m", "octasplat"]
    front_end = subprocess.Popen([*command, "api"], env=given, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert front_end.stdout is not None
    address = front_end.stdout.readline().strip()
    assert address.startswith("http")
    worker = subprocess.Popen([*command, "worker", "--queues", "cpu"], env=given, cwd=ROOT)
    yield address
    for process in (worker, front_end):
        process.terminate()
        process.wait(120)
    front_end.stdout.close()


@pytest.fixture
def document(server: str, tmp_path: Path) -> Path:
    place = tmp_path / "openapi.json"
    place.write_bytes(httpx.get(f"{server}/openapi.json", timeout=60).raise_for_status().content)
    return place


def check_result(folder: Path, output: str) -> None:
    assert output.startswith("succeeded ") and float(output.split()[1]) > 10
    assert {"scene.ply", "viewer.glb", "report.html"} <= {path.name for path in folder.iterdir()}
    assert json.loads((folder / "metrics.json").read_text())["gaussians"] > 0


def python_environment() -> Path:
    """Programs of an environment with the generator, installed on first use; skips where that cannot be."""
    folder = Path(user_cache_dir("octasplat")) / "pip" / PYTHON_GENERATOR.replace("==", "-")
    programs = folder / "bin"
    if not (programs / "openapi-python-client").exists():
        venv.create(folder, with_pip=True, clear=True)
        command = [programs / "pip", "install", "-q", PYTHON_GENERATOR]
        done = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS, check=False)
        if done.returncode != 0:
            pytest.skip(f"pip could not install {PYTHON_GENERATOR}: {done.stderr.strip()[-300:]}")
    return programs


@pytest.mark.exhaustive
def test_generated_python_client_submits_waits_and_downloads(
    server: str, document: Path, scene: Path, tmp_path: Path
) -> None:
    programs = python_environment()
    path = f"{programs}{os.pathsep}{os.environ['PATH']}"
    told = run(
        programs / "openapi-python-client", "generate", "--path", document, "--output-path", "client",
        folder=tmp_path, PATH=path,
    )  # fmt: skip
    assert "Endpoint will not be generated" not in told.stdout + told.stderr
    (tmp_path / "submit.py").write_text(program("python"))
    done = run(
        programs / "python", "submit.py", server, TOKEN, scene, "result",
        folder=tmp_path, PYTHONPATH=str(tmp_path / "client"),
    )  # fmt: skip
    check_result(tmp_path / "result", done.stdout)


@pytest.mark.exhaustive
def test_generated_typescript_client_submits_waits_and_downloads(
    server: str, document: Path, scene: Path, tmp_path: Path
) -> None:
    beside = ("openapi-typescript@7.13.0", "typescript@5.9.3", "@types/node@20")
    packages = npm_folder("openapi-fetch", "0.17.0", *beside) / "node_modules"
    (tmp_path / "node_modules").symlink_to(packages)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    run(
        packages / ".bin" / "openapi-typescript", document, "--default-non-nullable", "false",
        "--output", "schema.d.ts",
        folder=tmp_path,
    )  # fmt: skip
    (tmp_path / "submit.mts").write_text(program("ts"))
    run(
        packages / ".bin" / "tsc", "--strict", "--target", "es2022", "--module", "nodenext", "--skipLibCheck",
        "--types", "node", "submit.mts",
        folder=tmp_path,
    )  # fmt: skip
    done = run("node", "submit.mjs", server, TOKEN, str(scene), "result", folder=tmp_path)
    check_result(tmp_path / "result", done.stdout)
