"""The client of the package on a real service, which reconstructs a small scene."""

import doctest
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

import octasplat as osp
import octasplat.client
from octasplat.client import JobFailedError, ServiceError, ServiceUnreachableError
from octasplat.engine.core.events import Event, PhaseStarted
from octasplat.workers.client.api import find_address, find_token
from tests.support.postgres_fixtures import short_root

__all__ = ["short_root"]
pytestmark = pytest.mark.heavy


@dataclass(frozen=True)
class Service:
    """Where a running service is."""

    url: str
    token: str


@pytest.fixture(scope="module")
def service(short_root: Path) -> Iterator[Service]:
    data = short_root / "python-client"
    environment = {**os.environ, "OCTASPLAT_FLOOR_BYTES": "0", "OCTASPLAT_POLL_SECONDS": "0.2"}
    log = short_root / "python-client.log"
    with log.open("wb") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", "octasplat", "serve", "--data", str(data), "--port", "0"],
            env=environment,
            stdout=output,
            stderr=output,
        )
    deadline = time.monotonic() + 240
    while not (data / "serve.json").exists():
        assert process.poll() is None and time.monotonic() < deadline, log.read_text()
        time.sleep(0.1)
    address = find_address({}, data)
    token = find_token({}, address, data)
    assert token is not None
    yield Service(address, token)
    process.terminate()
    assert process.wait(120) == 0


SMALL = {
    "preset": "fast",
    "train": {"iterations": 60, "rays_per_batch": 512, "max_gaussians": 300},
    "exports": ["mesh.ply"],
}


@pytest.mark.exhaustive
def test_client_submit_and_download_round_trip(service: Service, photographs: Path, tmp_path: Path) -> None:
    events: list[Event] = []
    with osp.Client(service.url, service.token) as client:
        job = client.submit(photographs, label="a trial", progress=events.append, **SMALL)
        assert (job.kind, job.label) == ("reconstruct", "a trial")
        assert job.wait(progress=events.append).state == "succeeded"
        stages = [event.stage for event in events if isinstance(event, PhaseStarted)]
        assert stages[0] == "upload" and {"train", "evaluate", "export"} <= set(stages)
        assert {"scene.ply", "metrics.json", "mesh.ply"} <= {result.name for result in job.results()}
        run = osp.Run(job.download(tmp_path / "out", progress=events.append)[0].parent)
        assert run.psnr == pytest.approx(job.refresh().psnr)
        assert "a trial" in job._repr_html_() and [other.id for other in client.jobs()] == [job.id]

        derived = client.derive(job, "render", frames=2, width_px=32, height_px=24, format="png").wait()
        assert len(derived.download(tmp_path / "views")) >= 2
        assert client.job(derived.id).kind == "render"

        next_one = client.submit(start_from=job, preset="fast").cancel()
        assert next_one.content["source_id"] == job.id
        assert next_one.content["dataset_id"] == job.content["dataset_id"]


def test_refused_request_raises_service_error(service: Service, photographs: Path) -> None:
    with osp.Client(service.url, service.token) as client:
        with pytest.raises(ServiceError, match="iteratoins"):
            client.submit(photographs, train={"iteratoins": 3})
        with pytest.raises(ServiceError):
            client.job("00000000-0000-0000-0000-000000000000")
        job = client.submit(photographs, **SMALL).cancel()
        with pytest.raises(JobFailedError, match="cancelled"):
            job.wait()
        assert job.state == "canceled"
        with pytest.raises(ServiceError, match="neither a scene nor a checkpoint"):
            client.submit(start_from=job)
    with (
        osp.Client(service.url, "not-a-token") as stranger,
        pytest.raises(ServiceError, match="OCTASPLAT_TOKEN"),
    ):
        list(stranger.jobs())


def test_unreachable_address_raises_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("octasplat.workers.client.api.MAX_FIRST_OUTAGE_SECONDS", 0.1)
    with (
        osp.Client("http://127.0.0.1:9", "token") as client,
        pytest.raises(ServiceUnreachableError, match="octasplat serve"),
    ):
        list(client.jobs())


def test_examples_of_the_client_run(service: Service, in_folder: Path) -> None:
    found = {"url": service.url, "token": service.token}
    failed, count = doctest.testmod(octasplat.client, extraglobs=found, optionflags=doctest.ELLIPSIS)
    assert failed == 0 and count > 0


def test_files_of_one_name_are_refused() -> None:
    with (
        osp.Client("http://127.0.0.1:9", "token") as client,
        pytest.raises(osp.OctasplatError, match="one name"),
    ):
        client.derive("job", "relight", files=["a/sky.hdr", "b/sky.hdr"])


def test_submit_missing_file_is_refused_before_upload(tmp_path: Path) -> None:
    with (
        osp.Client("http://127.0.0.1:9", "token") as client,
        pytest.raises(osp.ConfigError, match=r"sky\.hdr: there is no such file"),
    ):
        client.derive("job", "relight", files=[tmp_path / "sky.hdr"], environments=["sky.hdr"])
