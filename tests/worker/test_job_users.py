"""Each job runs as a user of its own where root names some, and it is said where that is not so."""

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.workers.sandbox.capabilities import log_missing_capabilities, sandbox_capabilities
from octasplat.workers.sandbox.job_users import check_job_users, parse_uids, take_user
from tests.support.worker_harness import WorkerHarness

UIDS = range(231072, 231074)


@pytest.fixture
def bench(
    conninfo: str, short_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[WorkerHarness]:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(short_root / "code"))
    work = short_root / "job-users"
    try:
        check_job_users(UIDS, 2, work)
    except ConfigError as error:
        pytest.skip(str(error))
    bench = WorkerHarness(conninfo, tmp_path)
    bench.worker(
        queues="cpu=2",
        KIND_MODULES='["tests.support.hostile_kind"]',
        WORK=str(work),
        JOB_UIDS=f"{UIDS[0]}-{UIDS[-1]}",
    )
    yield bench
    bench.close()


def test_each_job_runs_as_a_user_of_its_own(bench: WorkerHarness, short_root: Path) -> None:
    secret = short_root / "secret"
    secret.write_text("a secret")
    secret.chmod(0o600)
    first = bench.submit("hostile", options={"attack": "daemon", "lasts": True})
    bench.wait(first, lambda job: job.stage == "evaluate")
    second = bench.submit("hostile", options={"attack": "user", "target": str(secret)})
    assert bench.wait_until_finished(second).state == "succeeded", bench.log(second)
    found = json.loads(bench.results(second)["found.json"])
    (uid,) = set(found.pop("user"))
    assert uid in UIDS and found.pop("folder") == 1
    assert set(found.values()) == {"PermissionError"}
    (folder,) = (path for path in (short_root / "job-users" / "attempts").iterdir())
    assert {folder.stat().st_uid, uid} == set(UIDS)
    bench.cancel(first)
    assert bench.wait_until_finished(first).state in ("canceled", "succeeded")


def test_users_are_given_to_one_job_at_a_time(tmp_path: Path) -> None:
    first, second = take_user(UIDS, tmp_path), take_user(UIDS, tmp_path)
    assert {first.uid, second.uid} == set(UIDS)
    with pytest.raises(ConfigError, match="OCTASPLAT_JOB_UIDS"):
        take_user(UIDS, tmp_path)
    first.close()
    third = take_user(UIDS, tmp_path)
    assert third.uid == first.uid
    second.close()
    third.close()


def test_a_user_for_each_job_at_once_is_needed(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="2 users for 3 jobs"):
        check_job_users(UIDS, 3, tmp_path)


@pytest.mark.parametrize("text", ["", "0-10", "999-2000", "5000-4000", "5000", "a-b", "5000-9999999999"])
def test_ranges_of_users_are_checked(text: str) -> None:
    with pytest.raises(ValueError, match="range of user ids"):
        parse_uids(text)
    assert parse_uids("5000-5001") == range(5000, 5002)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root is warned of")
def test_service_of_root_says_how_it_is_done_right(caplog: pytest.LogCaptureFixture) -> None:
    log_missing_capabilities(None)
    assert "runs as root" in caplog.text and "OCTASPLAT_JOB_UIDS" in caplog.text
    assert sandbox_capabilities()["user_of_jobs"] == "root, as the service"
    caplog.clear()
    log_missing_capabilities(UIDS)
    assert "root" not in caplog.text
    assert sandbox_capabilities(UIDS)["user_of_jobs"] == "one of its own for each job (231072-231073)"
