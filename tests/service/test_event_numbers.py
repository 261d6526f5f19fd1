"""Events and lines of the log are numbered by job: what one's own are called tells nothing of other jobs."""

from tests.support.service_harness import ConnectService, claim_job, new_job


async def test_numbers_count_the_rows_of_the_job_alone(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        jobs = [await new_job(http, service) for _ in range(3)]
        attempts = [await claim_job(service, job) for job in jobs]
        for number in range(4):
            for attempt in attempts:
                await attempt.add_log_lines([f"line {number}", f"more {number}"])
                await attempt.set_progress(stage="train", step=number, total_steps=9, event={"step": number})
        for job in jobs:
            lines = (await http.get(f"/v1/jobs/{job['id']}/logs")).json()
            assert [line["id"] for line in lines["lines"]] == list(range(1, 10)) and lines["next"] == 9
            events = (await http.get(f"/v1/jobs/{job['id']}/timeline")).json()
            assert [event["id"] for event in events["events"]] == list(range(1, 7)) and events["next"] == 6
        for attempt in attempts:
            await attempt.succeed([])
        stream = await http.get(f"/v1/jobs/{jobs[1]['id']}/events", headers={"Last-Event-ID": "4"})
        ids = [line for line in stream.text.splitlines() if line.startswith("id:")]
        assert ids == ["id: 5", "id: 6", "id: 7"]


async def test_a_number_that_the_job_never_had_begins_anew(connect_service: ConnectService) -> None:
    """As a client has it that was told the numbers of all jobs by the former version."""
    async with connect_service() as (http, service):
        job = await new_job(http, service)
        attempt = await claim_job(service, job)
        await attempt.succeed([])
        stream = await http.get(f"/v1/jobs/{job['id']}/events", headers={"Last-Event-ID": "5000"})
        assert [line for line in stream.text.splitlines() if line.startswith("id:")] == [
            "id: 1", "id: 2", "id: 3",
        ]  # fmt: skip
        last = await http.get(f"/v1/jobs/{job['id']}/events", headers={"Last-Event-ID": "3"})
        assert last.status_code == 204
        assert (await http.get(f"/v1/jobs/{job['id']}/logs?after=5000")).json()["lines"]
