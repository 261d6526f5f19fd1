"""Nothing that lies in the current folder or in PYTHONPATH is run, whatever it is called."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from octasplat.engine.core.isolated_python import python_command
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.workers.client.api import Api
from octasplat.workers.client.upload import upload_scene
from octasplat.workers.client.watch import watch_job

ROOT = Path(__file__).parents[2]
START = "import sys; sys.path.append({root!r}); from octasplat.workers.cli.main import main; main()"


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A folder with packages named as ours and as what we use, which say so when they are imported."""
    folder = tmp_path / "project"
    for package in ("service", "workers", "engine", "uvicorn", "numpy", "psycopg"):
        (folder / package).mkdir(parents=True)
        text = f"open({str(tmp_path / 'imported')!r}, 'a').write({package + ' '!r})\nraise SystemExit(9)\n"
        (folder / package / "__init__.py").write_text(text)
        (folder / package / "__main__.py").write_text(text)
    (folder / "sitecustomize.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'a').write('site ')\n")
    return folder


@pytest.fixture
def served(project: Path, short_root: Path, tmp_path: Path) -> Iterator[Api]:
    """``octasplat serve``, started in that folder and with it in PYTHONPATH."""
    data = short_root / "isolated"
    environment = {
        **os.environ,
        "PYTHONPATH": str(project),
        "OCTASPLAT_KIND_MODULES": '["tests.support.toy_kind"]',
        "OCTASPLAT_FLOOR_BYTES": "0",
        "OCTASPLAT_STORAGE": "a store",  # below the folder that it was started in
        "OMP_NUM_THREADS": "1",
    }
    # As the installed program does it: the folder of the script comes first, not the current one.
    command = [sys.executable, "-E", "-P", "-c", START.format(root=str(ROOT)), "serve", "--port", "0"]
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen(
            [*command, "--data", str(data)], cwd=project, env=environment, stdout=log, stderr=log
        )
    deadline = time.monotonic() + 120
    while not (data / "serve.json").exists():
        said = (tmp_path / "log").read_text(errors="replace")
        assert process.poll() is None and time.monotonic() < deadline, said
        assert not (tmp_path / "imported").exists(), (tmp_path / "imported").read_text()
        time.sleep(0.05)
    with Api.local(data) as api:
        yield api
    process.terminate()
    assert process.wait(120) == 0


@pytest.mark.exhaustive
def test_serve_ignores_modules_in_current_folder(served: Api, project: Path, tmp_path: Path) -> None:
    config = SyntheticDatasetConfig(views=4, width_px=16, height_px=12, samples_per_side=1, points=60)
    write_synthetic_dataset(tmp_path / "scene", config)
    dataset = upload_scene(served, tmp_path / "scene")
    job = served.post("/v1/jobs", {"kind": "toy", "dataset_id": dataset["id"], "options": {"steps": 2}})
    done = watch_job(served, job["id"], lambda _event: None, lambda _state: None)
    assert done["state"] == "succeeded", done
    assert not (tmp_path / "imported").exists(), (tmp_path / "imported").read_text()
    assert (project / "a store").is_dir()  # settings mean what they meant where the command was given


def test_program_paths_are_independent_of_current_folder(project: Path, tmp_path: Path) -> None:
    command = python_command(
        "octasplat", "--version", further_modules=("no_such_module", "tests.support.toy_kind")
    )
    environment = {**os.environ, "PYTHONPATH": str(project)}
    done = subprocess.run(command, cwd=project, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "") and "octasplat, version" in done.stdout
    assert not (tmp_path / "imported").exists()


def test_command_ignores_modules_in_current_folder(project: Path, tmp_path: Path) -> None:
    script = Path(sys.executable).with_name("octasplat")
    if not script.exists():
        pytest.skip("octasplat is not installed beside this Python")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [str(script), "serve", "--help"]
    done = subprocess.run(command, cwd=project, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "Run the API" in done.stdout, done.stderr
    assert not (tmp_path / "imported").exists()
