"""A reconstruction that begins with the Gaussians of another job: what is accepted, and what is refused."""

import uuid
from typing import Any

import pytest
from psycopg.types.json import Jsonb

from octasplat.service.state import Service
from octasplat.workers.db.locks import lock_owner
from tests.service.conftest import connect_service
from tests.support.service_harness import ConnectService, client_with_token, committed_dataset, store_content

__all__ = ["connect_service"]

STEP = "run/checkpoints/iteration_000010.npz"
START = "run/start/start.json"


async def make_source(
    service: Service,
    *,
    owner: str = "local",
    kind: str = "reconstruct",
    state: str = "succeeded",
    results: tuple[str, ...] = (),
    checkpoint: tuple[str, ...] = (),
    dataset: str | None = None,
) -> str:
    """A job as workers leave it."""
    job_id, content = uuid.uuid4(), store_content(service, b"made")
    kept = {
        "attempt": 1,
        "stage": "train",
        "step": 10,
        "files": [{"path": name, "sha256": content, "size_bytes": 4} for name in checkpoint],
    }
    async with service.pool.connection() as connection:
        await lock_owner(connection, owner)
        await connection.execute(
            "INSERT INTO jobs (id, owner, kind, dataset_id, options, queue, priority, state, checkpoint) "
            "VALUES (%s, %s, %s, %s, '{}', 'cpu', 0, %s, %s)",
            [job_id, owner, kind, dataset, state, Jsonb(kept) if checkpoint else None],
        )
        for name in results:
            await connection.execute(
                "INSERT INTO artifacts (job_id, name, sha256, size_bytes, media_type) "
                "VALUES (%s, %s, %s, 4, 'application/octet-stream')",
                [job_id, name, content],
            )
    return str(job_id)


async def test_job_begins_with_another_on_its_photographs(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        dataset = await committed_dataset(service, has_poses=False)
        source = await make_source(service, results=("scene.ply",), dataset=dataset)
        body = {"source_id": source, "options": {"preset": "high"}}
        answer = await http.post("/v1/jobs", json=body)
        assert answer.status_code == 202, answer.text
        job = answer.json()
        assert (job["dataset_id"], job["source_id"]) == (dataset, source)
        assert job["options"]["begins_with_source"] is True
        assert job["requested"] == {"preset": "high", "poses": "auto", "begins_with_source": True}
        assert job["stages"] == ["load", "train", "evaluate", "export"]  # the poses are those of the source
        other = await committed_dataset(service)
        more = (await http.post("/v1/jobs", json={**body, "dataset_id": other})).json()
        assert (more["dataset_id"], more["source_id"]) == (other, source)
        plain = (await http.post("/v1/jobs", json={"dataset_id": other})).json()
        assert plain["options"]["begins_with_source"] is False
        assert "begins_with_source" not in plain["requested"]
        # As long as the job is to be done, what it begins with stays.
        refused = await http.delete(f"/v1/jobs/{source}")
        assert refused.status_code == 409 and "unfinished jobs work on" in refused.json()["detail"]


@pytest.mark.parametrize(
    ("source", "status", "sentence"),
    [
        ({"owner": "ann"}, 422, "There is no such job."),
        (
            {"kind": "crop", "results": ("scene.ply",)},
            422,
            "begins with one of its own kind; source_id is a crop.",
        ),
        (
            {"state": "running", "checkpoint": (STEP,)},
            409,
            "is running; wait until it is over, or cancel it.",
        ),
        ({"state": "queued"}, 409, "is queued; wait until it is over, or cancel it."),
        ({"state": "canceled"}, 409, "is canceled and has neither a scene nor a checkpoint."),
        ({"state": "failed", "results": ("config.json",)}, 409, "is failed and has neither a scene nor"),
        (
            {"state": "canceled", "checkpoint": ("run/blocks/plan.npz",)},
            409,
            "neither a scene nor a checkpoint",
        ),
    ],
)
async def test_what_cannot_be_begun_with_is_refused(
    connect_service: ConnectService, source: dict[str, Any], status: int, sentence: str
) -> None:
    async with connect_service() as (http, service):
        given = {"dataset": await committed_dataset(service), "results": ("scene.ply",), **source}
        if "checkpoint" in source or source.get("state") in ("queued", "canceled"):
            given["results"] = source.get("results", ())
        as_eve = await client_with_token(service, "eve", "read", "write")
        headers = as_eve if "owner" in source else {}
        source_id = await make_source(service, **given)
        own = await committed_dataset(service, "eve" if "owner" in source else "local")
        body = {"source_id": source_id, "dataset_id": own}
        answer = await http.post("/v1/jobs", json=body, headers=headers)
        assert answer.status_code == status and sentence in answer.json()["detail"], answer.text


async def test_contradictions_are_refused(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        dataset = await committed_dataset(service)
        source = await make_source(service, results=("scene.ply",), dataset=dataset)
        in_blocks = await http.post("/v1/jobs", json={"source_id": source, "options": {"blocks": 2}})
        assert in_blocks.status_code == 422 and "begins anew" in in_blocks.json()["detail"]
        assert in_blocks.json()["errors"][0]["pointer"] == "#/options/blocks"
        # Options of such a job, sent again as they were shown, but without what it began with.
        body = {"dataset_id": dataset, "options": {"begins_with_source": True}}
        without = await http.post("/v1/jobs", json=body)
        assert without.status_code == 422 and "name source_id" in without.json()["detail"]
        orphan = await make_source(service, results=("scene.ply",))
        gone = await http.post("/v1/jobs", json={"source_id": orphan})
        assert gone.status_code == 422 and "were deleted; name some as dataset_id" in gone.json()["detail"]
        for kind, named in (("render", source), ("toy", source)):
            answer = await http.post(
                "/v1/jobs", json={"kind": kind, "source_id": named, "dataset_id": dataset}
            )
            assert answer.status_code == 422, answer.text


async def test_job_whose_start_was_deleted_goes_on_only_with_its_own_copy(
    connect_service: ConnectService,
) -> None:
    async with connect_service() as (http, service):
        dataset = await committed_dataset(service)
        source = await make_source(service, state="canceled", checkpoint=(STEP,), dataset=dataset)
        job = (await http.post("/v1/jobs", json={"source_id": source})).json()
        address = f"/v1/jobs/{job['id']}"
        assert (await http.post(f"{address}/cancel")).json()["state"] == "canceled"
        assert (await http.delete(f"/v1/jobs/{source}")).status_code == 204
        assert (await http.get(address)).json()["source_id"] is None
        for start in ("start", "checkpoint"):  # it has none yet
            refused = await http.post(f"{address}/retry", json={"from": start})
            assert refused.status_code == 409 and "was deleted; make a new job" in refused.json()["detail"]
        kept = {"attempt": 1, "stage": "train", "step": 10}
        kept["files"] = [{"path": name, "sha256": "0" * 64, "size_bytes": 4} for name in (START, STEP)]
        async with service.pool.connection() as connection:
            await lock_owner(connection, "local")
            query = "UPDATE jobs SET checkpoint = %s WHERE id = %s"
            await connection.execute(query, [Jsonb(kept), job["id"]])
        refused = await http.post(f"{address}/retry", json={"from": "start"})
        assert refused.status_code == 409
        again = await http.post(f"{address}/retry", json={"options": {"exports": ["viewer.glb"]}})
        assert again.status_code == 202, again.text
        assert again.json()["options"]["begins_with_source"] is True
        assert again.json()["state"] == "queued"


async def test_retry_cannot_change_what_a_job_begins_with(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        dataset = await committed_dataset(service)
        source = await make_source(service, results=("scene.ply",), dataset=dataset)
        job = (await http.post("/v1/jobs", json={"source_id": source})).json()
        await http.post(f"/v1/jobs/{job['id']}/cancel")
        body = {"from": "start", "options": {"blocks": 2}}
        refused = await http.post(f"/v1/jobs/{job['id']}/retry", json=body)
        assert refused.status_code == 422 and "begins anew" in refused.json()["detail"]
        body = {"from": "start", "options": {"preset": "fast"}}
        again = (await http.post(f"/v1/jobs/{job['id']}/retry", json=body)).json()
        assert again["options"]["begins_with_source"] is True and again["source_id"] == source
        assert again["requested"] == {"preset": "fast", "poses": "given", "begins_with_source": True}


async def test_form_of_a_new_job_offers_the_gaussians_of_another(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        dataset = await committed_dataset(service)
        source = await make_source(service, results=("scene.ply",), dataset=dataset)
        page = (await http.get("/new", params={"like": source})).text
        assert f'id="begin-with" value="{source}"' in page
        assert "Begin with the Gaussians of this job" in page
        empty = await make_source(service, state="canceled", dataset=dataset)
        assert "begin-with" not in (await http.get("/new", params={"like": empty})).text
        assert "begin-with" not in (await http.get("/new")).text
