"""Parts of sorted lists of jobs, between which jobs are deleted, or which begin at a job of somebody else."""

import pytest

from octasplat.service.paging import encode_cursor
from tests.support.service_harness import ConnectService, client_with_token, new_job

ORDERS = ("newest", "oldest", "name", "psnr", "longest")


@pytest.mark.parametrize("order", ORDERS)
async def test_list_goes_on_or_says_so_after_its_last_job_was_deleted(
    connect_service: ConnectService, order: str
) -> None:
    async with connect_service() as (http, service):
        jobs = {(await new_job(http, service, label=label))["id"] for label in "abc"}
        part = (await http.get("/v1/jobs", params={"order": order, "limit": 1})).json()
        [first] = [job["id"] for job in part["jobs"]]
        query = {"order": order, "cursor": part["next"]}
        assert (await http.delete(f"/v1/jobs/{first}", params={"cancel": True})).status_code == 204
        rest = await http.get("/v1/jobs", params=query)
        if order in ("newest", "oldest"):
            assert {job["id"] for job in rest.json()["jobs"]} == jobs - {first}
        else:  # where it was is known no more
            assert rest.status_code == 422 and rest.json()["type"].endswith(":cursor")


@pytest.mark.parametrize("order", ["name", "psnr", "longest"])
async def test_jobs_of_others_begin_no_part_of_a_sorted_list(
    connect_service: ConnectService, order: str
) -> None:
    """What comes behind them would tell their names and figures."""
    async with connect_service() as (http, service):
        job = await new_job(http, service, label="b")
        other = await client_with_token(service, "other", "read")
        query = {"order": order, "cursor": encode_cursor(job["id"])}
        answer = await http.get("/v1/jobs", params=query, headers=other)
        assert answer.status_code == 422
        last = await http.get("/v1/jobs", params=query)
        assert last.status_code == 200 and last.json()["jobs"] == []
