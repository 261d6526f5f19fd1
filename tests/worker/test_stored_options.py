"""Options of jobs are stored as asked for, so that versions with other defaults run each other's jobs."""

import asyncio
import json
import uuid
from pathlib import Path
from typing import Any

import pytest
from psycopg.types.json import Jsonb

from octasplat.engine import __version__
from octasplat.service.state import Service
from octasplat.workers.worker.job_kinds import get_job_kind
from octasplat.workers.worker.job_kinds.stored_options import (
    requested_options,
    resolve_requested,
    without_defaults,
)
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
        assert job["requested"] == {"steps": 3} and job["resolved_by"] is None
        async with service.pool.connection() as connection:
            query = "SELECT options, requested FROM jobs WHERE id = %s"
            row = await (await connection.execute(query, [job["id"]])).fetchone()
        assert row is not None and row["options"] == row["requested"] == {"steps": 3}


RECONSTRUCTIONS: list[tuple[dict[str, Any], dict[str, Any]]] = [
    ({"preset": "fast"}, {"preset": "fast"}),
    ({"preset": "standard"}, {"preset": "standard"}),
    (
        {"for_surface": True, "materials": False},
        {"for_surface": True, "train": {"materials": {"learn": False}}},
    ),
    (
        {"iterations": 300, "set": ["lr.mean=0.001", "test_every=4"]},
        {"test_every": 4, "train": {"iterations": 300, "lr": {"mean": 0.001}}},
    ),
    ({"rays": 512}, {"train": {"rays_per_batch": 512}}),
]


@pytest.mark.filterwarnings("ignore::octasplat.engine.settings.renamed_settings.RenamedSettingWarning")
@pytest.mark.parametrize(
    ("asked", "requested"), RECONSTRUCTIONS, ids=[str(asked) for asked, _ in RECONSTRUCTIONS]
)
def test_requested_options_have_nothing_of_a_preset(asked: dict[str, Any], requested: dict[str, Any]) -> None:
    kind = get_job_kind("reconstruct")
    complete = resolve_requested(kind, asked)
    assert requested_options(kind, asked, complete) == requested
    assert resolve_requested(kind, requested) == complete


@pytest.mark.parametrize(
    ("requested", "changes", "revised"),
    [
        (
            {"train": {"lr": {"mean": 0.1}}},
            {"train": {"seed": 1}},
            {"train": {"lr": {"mean": 0.1}, "seed": 1}},
        ),
        ({"preset": "fast", "train": {"seed": 1}}, {"preset": "thorough"}, {"preset": "thorough"}),
        (
            {"for_surface": True},
            {"train": {"loss": {"depth_normal": 0.0}}},
            {"train": {"loss": {"depth_normal": 0}}},
        ),
        ({"exports": ["a.spz"]}, {"for_surface": True}, {"exports": ["a.spz"], "for_surface": True}),
    ],
)
def test_requested_options_are_revised(
    requested: dict[str, Any], changes: dict[str, Any], revised: dict[str, Any]
) -> None:
    assert get_job_kind("reconstruct").revise_requested(requested, changes) == revised


def test_preset_of_other_kinds_is_not_resolved() -> None:
    kind = get_job_kind("surface")
    assert requested_options(kind, {"room": True}, resolve_requested(kind, {"room": True})) == {"room": True}


async def requested_of(service: Service, job: dict[str, Any]) -> Any:
    async with service.pool.connection() as connection:
        cursor = await connection.execute("SELECT requested FROM jobs WHERE id = %s", [job["id"]])
        row = await cursor.fetchone()
    assert row is not None
    return row["requested"]


async def test_default_that_is_asked_for_is_stored_and_so_is_what_the_dataset_decides(
    connect_service: ConnectService,
) -> None:
    async with connect_service() as (http, service):
        job = await new_job(http, service, options={"steps": 10})
        assert await requested_of(service, job) == {"steps": 10}
        job = await new_job(
            http, service, kind="reconstruct", options={"preset": "standard", "poses": "missing"}
        )
        assert await requested_of(service, job) == {"preset": "standard", "poses": "given"}
        assert job["options"]["poses"] == "given"


async def test_retry_changes_what_was_asked_for(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        job = await new_job(http, service, options={"steps": 10, "seconds": 0.5})
        await http.post(f"/v1/jobs/{job['id']}/cancel")
        again = await http.post(f"/v1/jobs/{job['id']}/retry", json={"options": {"seconds": 0.02}})
        assert again.status_code == 202 and again.json()["options"]["seconds"] == 0.02
        assert await requested_of(service, job) == {"steps": 10, "seconds": 0.02}


async def test_changes_by_the_last_version_count(connect_service: ConnectService) -> None:
    """Its front end changes ``options`` alone."""
    async with connect_service() as (http, service):
        job = await new_job(http, service, options={"steps": 10})
        async with service.pool.connection() as connection:
            await connection.execute("UPDATE jobs SET label = 'x' WHERE id = %s", [job["id"]])
        assert await requested_of(service, job) == {"steps": 10}
        async with service.pool.connection() as connection:
            query = "UPDATE jobs SET options = %s WHERE id = %s"
            await connection.execute(query, [Jsonb({"steps": 7}), job["id"]])
        assert await requested_of(service, job) is None


@pytest.mark.exhaustive
async def test_worker_of_a_version_with_other_defaults_completes_what_was_asked_for(
    connect_service: ConnectService, conninfo: str, tmp_path: Path
) -> None:
    bench = WorkerHarness(conninfo, tmp_path)
    try:
        async with connect_service() as (http, service):
            asked = await new_job(http, service, options={"steps": 10})
            unasked = await new_job(http, service)
            assert asked["options"] == unasked["options"]  # as the front end completes them
            other = ["tests.support.toy_kind", "tests.support.next_version_defaults"]
            await asyncio.to_thread(bench.worker, KIND_MODULES=json.dumps(other))
            steps = []
            for job in (asked, unasked):
                done = await asyncio.to_thread(bench.wait_until_finished, uuid.UUID(job["id"]))
                assert done.state == "succeeded" and done.settings is not None
                steps.append(done.settings["steps"])
            assert steps == [10, 4]
    finally:
        await asyncio.to_thread(bench.close)


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
