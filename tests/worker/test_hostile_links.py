"""What a job has replaced by links is not followed by its worker, which may read everything."""

import hashlib
import os
from pathlib import Path

import pytest

from octasplat.workers.storage.errors import BlobNotFoundError
from octasplat.workers.storage.factory import open_storage
from tests.support.worker_harness import WorkerHarness

SECRET = b"the token of the administrator"


@pytest.fixture
def bench(shared_bench: WorkerHarness) -> WorkerHarness:
    return shared_bench


@pytest.fixture
def shut(tmp_path: Path) -> Path:
    """A folder with a secret in it, which is none of the job's."""
    folder = tmp_path / "data"
    folder.mkdir(mode=0o700)
    (folder / "token").write_bytes(SECRET)
    return folder


def is_stored(bench: WorkerHarness, content: bytes) -> bool:
    try:
        open_storage(bench.folder / "store").stat(hashlib.sha256(content).hexdigest())
    except BlobNotFoundError:
        return False
    return True


def test_preview_is_not_taken_through_a_link(bench: WorkerHarness, shut: Path) -> None:
    job_id = bench.submit("hostile", options={"attack": "link run", "target": str(shut)})
    bench.wait(job_id, lambda job: job.is_over or "Warning: a preview" in bench.log(job_id))
    (shut.parent / "gate").touch()
    job = bench.wait_until_finished(job_id)
    assert job.state == "succeeded" and job.preview is None
    assert not is_stored(bench, SECRET)
    assert bench.results(job_id) == {"done.txt": b"done"}


@pytest.mark.parametrize("attack", ["link results", "link result"])
def test_results_are_regular_files_of_the_job_alone(bench: WorkerHarness, shut: Path, attack: str) -> None:
    target = shut if attack == "link results" else shut / "token"
    job_id = bench.submit("hostile", options={"attack": attack, "target": str(target)})
    job = bench.wait_until_finished(job_id)
    assert (job.state, job.attempt) == ("failed", 1)
    assert job.error is not None and job.error["type"] == "not_a_file"
    assert bench.results(job_id) == {} and not is_stored(bench, SECRET)


def test_results_with_names_outside_of_the_job_are_refused(bench: WorkerHarness, shut: Path) -> None:
    job_id = bench.submit("hostile", options={"attack": "link run", "target": str(shut)})
    folder = bench.folder / "work-w" / "attempts" / f"{job_id}.1"
    bench.wait(job_id, lambda job: job.is_over or "Warning: a preview" in bench.log(job_id))
    (folder / "results").mkdir()
    os.link(shut / "token", folder / "results" / "token")
    (shut.parent / "gate").touch()
    job = bench.wait_until_finished(job_id)
    assert job.state == "failed" and job.error is not None and job.error["type"] == "not_a_file"
    assert not is_stored(bench, SECRET)


@pytest.mark.parametrize("place", ["results", "run/poses"])
def test_names_that_not_every_system_takes_are_the_job_s_fault_and_not_its_worker_s(
    bench: WorkerHarness, place: str
) -> None:
    job_id = bench.submit("hostile", options={"attack": "bad name", "target": place})
    job = bench.wait_until_finished(job_id)
    if place == "results":
        assert (job.state, job.attempt) == ("failed", 1)
        assert job.error is not None and job.error["type"] == "name_refused" and "nul.txt" in str(job.error)
    else:  # which are wanted for a later attempt alone
        assert (job.state, job.attempt) == ("succeeded", 1)
        assert "Warning: a checkpoint could not be stored" in bench.log(job_id)
