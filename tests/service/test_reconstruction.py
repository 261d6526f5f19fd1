"""The whole way on one machine: ``octasplat serve``, a scene over HTTP, everything killed, the same bytes."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import pytest
from click.testing import CliRunner

from octasplat.engine.operations.reconstruct import options_from_json
from octasplat.engine.pipeline import reconstruct
from octasplat.workers.cli.main import cli
from octasplat.workers.client.api import Api, ServiceError
from octasplat.workers.client.download import download_results
from octasplat.workers.client.submission import Submission, submit
from octasplat.workers.client.upload import upload_scene
from octasplat.workers.client.watch import watch_job
from octasplat.workers.serve.local_service import lock_data_folder
from tests.support.tiny_dataset import make_tiny_dataset

pytestmark = pytest.mark.heavy

ROOT = Path(__file__).parents[2]
TRAIN = {
    "iterations": 200,
    "rays_per_batch": 512,
    "sh_degree": 1,
    "max_gaussians": 500,
    "initial_points": 400,
    "densify_from_iter": 20,
    "rebuild_every": 25,
    "checkpoint_every": 25,
    "probe_rays": 256,
    "early_stopping_db": 0,
}
OPTIONS: dict[str, Any] = {"preset": "fast", "train": TRAIN}


@dataclass
class Machine:
    """A running ``octasplat serve``."""

    data: Path
    process: "subprocess.Popen[bytes]"

    @property
    def api(self) -> Api:
        return Api.local(self.data)

    def children(self, word: str) -> list[psutil.Process]:
        """Processes below whose command holds ``word``."""
        found = []
        for process in psutil.Process(self.process.pid).children(recursive=True):
            try:
                if word in " ".join(process.cmdline()):
                    found.append(process)
            except psutil.Error:
                continue
        return found

    def stop(self) -> int:
        if self.process.poll() is None:
            self.process.terminate()
        return self.process.wait(120)

    def start_again(self) -> None:
        """Start it on the same data folder after :meth:`stop`."""
        self.process = start(self.data).process


def start(data: Path) -> Machine:
    environment = {
        **os.environ,
        "OCTASPLAT_FLOOR_BYTES": "0",
        "OCTASPLAT_HEARTBEAT_SECONDS": "0.5",
        "OCTASPLAT_STALE_SECONDS": "3",
        "OCTASPLAT_RESCUE_SECONDS": "0.5",
        "OCTASPLAT_POLL_SECONDS": "0.2",
        "OMP_NUM_THREADS": "1",
        "NUMBA_NUM_THREADS": "2",
    }
    (data / "serve.json").unlink(missing_ok=True)
    log = data.parent / f"{data.name}.log"
    command = [sys.executable, "-m", "octasplat", "serve", "--data", str(data), "--port", "0"]
    with log.open("ab") as output:
        process = subprocess.Popen(command, env=environment, cwd=ROOT, stdout=output, stderr=output)
    machine = Machine(data, process)
    deadline = time.monotonic() + 240
    while not (data / "serve.json").exists():
        if process.poll() is not None or time.monotonic() > deadline:
            machine.stop()
            raise AssertionError(log.read_text())
        time.sleep(0.05)
    return machine


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_dataset(tmp_path_factory, width_px=48, height_px=36, points=500)


@pytest.fixture(scope="module")
def undisturbed(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = options_from_json(OPTIONS).config()
    return reconstruct(scene, tmp_path_factory.mktemp("undisturbed") / "run", config, threads=1)


@pytest.fixture(scope="module")
def machine(short_root: Path) -> Iterator[Machine]:
    """One service for all tests, which leave it running."""
    machine = start(short_root / "whole")
    yield machine
    machine.stop()


def contents(folder: Path) -> dict[str, bytes]:
    """The files that must not depend on what happened on the way."""
    names = ("scene.ply", "octagons.ply", "octagons.obj", "octagons.glb", "held_out.json", "views.json")
    renders = [path.relative_to(folder).as_posix() for path in folder.glob("renders/**/*.png")]
    assert renders
    return {name: (folder / name).read_bytes() for name in (*names, *sorted(renders))}


def check_what_is_shown(api: Api, machine: Machine, job: dict[str, Any]) -> None:
    """The log tells what was done, also by lost attempts, and nothing names a path of the machine."""
    environment = {
        **os.environ,
        "OCTASPLAT_DATA": str(machine.data),
    }

    def command(*arguments: str) -> str:
        run = [sys.executable, "-m", "octasplat", *arguments]
        return subprocess.run(
            run, cwd=ROOT, env=environment, capture_output=True, text=True, check=True
        ).stdout

    logs = command("logs", job["id"])
    for line in ("Attempt 1", "Lost, and queued again", "Goes on from step", "Loaded 8 photographs in",
                 "Trained 200 iterations in", "held out", "Exported", "Succeeded"):  # fmt: skip
        assert line in logs, logs
    assert f"PSNR {job['psnr']:.2f} dB over held-out views; {job['training_psnr']:.2f} dB" in command(
        "status", job["id"]
    )
    assert f"{job['psnr']:.2f} dB" in command("jobs")
    timeline = json.dumps(api.get(f"/v1/jobs/{job['id']}/timeline", limit=5000))
    for text in (logs, timeline, json.dumps(api.get(f"/v1/jobs/{job['id']}/logs"))):
        assert str(machine.data) not in text and str(ROOT) not in text and sys.prefix not in text
    previews = [event for event in json.loads(timeline)["events"] if event["kind"] == "preview"]
    assert previews and all(event["data"]["step"] > 0 for event in previews)


@pytest.mark.exhaustive
def test_reconstruction_after_kills_gives_same_bytes(
    machine: Machine, scene: Path, undisturbed: Path, tmp_path: Path
) -> None:
    with machine.api as api:
        job = submit(api, Submission(scene, OPTIONS, "killed"))
        address = f"/v1/jobs/{job['id']}"

        def until(ready: Any, seconds: float = 240.0) -> dict[str, Any]:
            deadline = time.monotonic() + seconds
            while not ready(now := api.get(address)):
                assert time.monotonic() < deadline, now
                time.sleep(0.05)
            found: dict[str, Any] = now
            return found

        until(lambda job: job["checkpoint"] is not None and job["checkpoint"]["step"] >= 25)
        for victim in machine.children("octasplat.workers.worker.child_main"):
            with contextlib.suppress(psutil.NoSuchProcess):  # it ends with its guard, which comes first
                victim.kill()
        until(lambda job: job["attempt"] >= 2 or job["state"] == "succeeded")
        for victim in machine.children("--queues cpu"):
            victim.kill()
        for victim in machine.children("-m service"):
            victim.kill()
        done = watch_job(api, job["id"], lambda _event: None, lambda _state: None)
        assert done["state"] == "succeeded", done
        assert 2 <= done["attempt"] <= 4
        events = api.get(f"/v1/jobs/{job['id']}/timeline", limit=5000)["events"]
        resumed = [event["data"]["step"] for event in events if event["kind"] == "resumed"]
        assert resumed and min(resumed) >= 25
        check_what_is_shown(api, machine, done)
        download_results(api, job["id"], tmp_path / "result")
        again = download_results(api, job["id"], tmp_path / "result")
    metrics = json.loads((tmp_path / "result" / "metrics.json").read_text())
    assert done["psnr"] == metrics["mean"]["psnr"] and done["training_psnr"] > 0
    texts = [path.read_text() for name in ("*.json*", "*.html") for path in (tmp_path / "result").glob(name)]
    assert len(texts) >= 6 and not any(str(machine.data) in text or str(ROOT) in text for text in texts)
    assert contents(tmp_path / "result") == contents(undisturbed)
    assert json.loads((tmp_path / "result" / "config.json").read_text())["scene"] == "scene"
    assert (tmp_path / "result" / "report.html") in again
    rendered = CliRunner().invoke(
        cli, ["render", str(tmp_path / "result"), "-o", str(tmp_path / "views"), "--threads", "1"]
    )
    assert rendered.exit_code == 0, rendered.output  # the photographs are not asked for
    assert (tmp_path / "views" / "view_000.png").exists()


@pytest.mark.exhaustive
def test_restarted_service_continues_and_derived_jobs_use_result(
    machine: Machine, scene: Path, undisturbed: Path, tmp_path: Path
) -> None:
    with machine.api as api:
        dataset = upload_scene(api, scene)
        assert dataset["state"] == "committed" and dataset["photographs"] == 8
        assert upload_scene(api, scene)["id"] == dataset["id"]  # nothing is sent twice
        job = submit(api, Submission(Path(dataset["id"]), OPTIONS))
        while api.get(f"/v1/jobs/{job['id']}")["checkpoint"] is None:
            time.sleep(0.05)
    assert machine.stop() == 0
    machine.start_again()
    with machine.api as api:
        done = watch_job(api, job["id"], lambda _event: None, lambda _state: None)
        assert done["state"] == "succeeded" and done["rescues"] == 0
        download_results(api, job["id"], tmp_path / "result")
        assert contents(tmp_path / "result") == contents(undisturbed)
        assert done["preview"]["view"].endswith(".png")
        picture = api.request("GET", f"/v1/jobs/{job['id']}/preview")
        assert picture.content.startswith(b"\x89PNG")
        # What a job of each kind makes of a result is tested in test_every_kind.py.
        (tmp_path / "thing.obj").write_text("v 0 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 3\n")
        stage = tmp_path / "stage.toml"
        stage.write_text('[[meshes]]\nfile = "thing.obj"\n[integrator]\nsamples = 1\n')
        words = (
            "--stage",
            stage,
            "--set",
            "mode=views",
            "--set",
            "format=png",
            "--label",
            "lit",
            "--wait",
        )
        command = ("derive", "render", job["id"], *words, "-o", tmp_path / "lit")
        environment = {"OCTASPLAT_DATA": str(machine.data)}
        lit = CliRunner(env=environment).invoke(cli, [str(word) for word in command])
        assert lit.exit_code == 0 and "Rendered 1 image in" in lit.output, lit.output
        assert (tmp_path / "lit" / "views" / "view_000.png").is_file()
        with pytest.raises(ServiceError, match="no result nothing"):
            download_results(api, job["id"], tmp_path, names=("nothing",))


@pytest.mark.exhaustive
def test_killed_database_is_restarted(machine: Machine, scene: Path) -> None:
    with machine.api as api:
        job = submit(api, Submission(scene, {**OPTIONS, "exports": []}))
        while api.get(f"/v1/jobs/{job['id']}")["checkpoint"] is None:
            time.sleep(0.05)
        pid = int((machine.data / "postgres/cluster/postmaster.pid").read_text().split()[0])
        os.kill(pid, signal.SIGKILL)
        done = watch_job(api, job["id"], lambda _event: None, lambda _state: None)
        assert done["state"] == "succeeded", done


def test_serve_on_locked_data_folder_is_refused(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "octasplat", "serve", "--data", str(tmp_path), "--port", "0"]
    with lock_data_folder(tmp_path):
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1 and "Another octasplat serve" in done.stderr
    assert "Traceback" not in done.stderr
