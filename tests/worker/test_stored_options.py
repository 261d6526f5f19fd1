"""Options of jobs are stored as asked for, so that versions with other defaults run each other's jobs."""

from pathlib import Path
from typing import Any

import pytest

from octasplat.engine import __version__
from octasplat.workers.worker.job_kinds import get_job_kind
from octasplat.workers.worker.job_kinds.stored_options import without_defaults
from tests.service.conftest import connect_service
from tests.support.service_harness import ConnectService, new_job
from tests.support.toy_kind import ToyOptions
from tests.support.worker_harness import WorkerHarness

__all__ = ["connect_service"]


class LaterOptions(ToyOptions):
    """The options of a later version, which has one more."""

    shade: float = 0.0


ASKED: list[tuple[str, dict[str, Any]]] = [
    *((name, {}) for name in ("reconstruct", "evaluate", "info", "clean", "surface")),
    ("reconstruct", {"preset": "fast"}),
    ("reconstruct", {"train": {"iterations": 300}, "exports": ["a.spz"]}),
    ("render", {"mode": "turntable", "frames": 3}),
    ("render", {"stage": {"lights": [{"kind": "point", "position": [0, 0, 0], "intensity": 1.0}]}}),
    ("material", {"set": {"roughness": 0.5}}),
]


@pytest.mark.parametrize(("name", "asked"), ASKED, ids=[f"{name}-{list(asked)}" for name, asked in ASKED])
def test_stored_options_are_completed_to_the_same(name: str, asked: dict[str, Any]) -> None:
    kind = get_job_kind(name)
    options = kind.resolve(asked)
    stored = without_defaults(options)
    assert kind.options.model_validate(stored) == options
    complete = options.model_dump(mode="json")
    assert len(str(stored)) <= len(str(complete)) and (asked or stored == {} or len(stored) < len(complete))


def test_default_of_a_later_version_is_not_stored() -> None:
    assert without_defaults(LaterOptions(steps=3)) == {"steps": 3}
    assert without_defaults(LaterOptions(steps=3, shade=0.5)) == {"steps": 3, "shade": 0.5}


async def test_job_is_stored_as_asked_and_shown_complete(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        job = await new_job(http, service, options={"steps": 3})
        assert job["options"]["steps"] == 3 and len(job["options"]) == len(ToyOptions.model_fields)
        assert job["resolved_by"] is None
        async with service.pool.connection() as connection:
            query = "SELECT options FROM jobs WHERE id = %s"
            row = await (await connection.execute(query, [job["id"]])).fetchone()
        assert row is not None and row["options"] == {"steps": 3}


def test_worker_runs_the_job_of_a_later_front_end_and_tells_its_version(
    conninfo: str, tmp_path: Path
) -> None:
    bench = WorkerHarness(conninfo, tmp_path)
    try:
        _run_job_of_later_front_end(bench)
    finally:
        bench.close()


def _run_job_of_later_front_end(bench: WorkerHarness) -> None:
    bench.worker()
    job = bench.wait_until_finished(bench.submit(options=without_defaults(LaterOptions(steps=3))))
    assert (job.state, job.resolved_by) == ("succeeded", __version__)
    assert job.settings is not None and job.settings["steps"] == 3 and len(job.settings) > 1
