"""Pages besides those of single jobs: search, comparison, datasets, usage, and changes of several jobs."""

import html
import json
import re
import uuid

import pytest

from octasplat.service.actions import jobs as job_actions
from octasplat.service.web.comparison import differing_settings
from octasplat.workers.db.connections import open_pool
from octasplat.workers.db.datasets import create_dataset, put_file
from octasplat.workers.db.tokens import add_token
from octasplat.workers.db.workers import record_worker_heartbeat
from octasplat.workers.queue.jobs import NewJob, create_job
from octasplat.workers.queue.procrastinate_queue import ProcrastinateQueue
from tests.support.service_harness import ConnectService

BROWSER = {"Accept": "text/html,application/xhtml+xml"}


async def make_job(database: str, **values: object) -> uuid.UUID:
    async with open_pool(database, max_size=1, wait_seconds=10) as pool, pool.connection() as connection:
        fields = {"owner": "local", "kind": "reconstruct", "options": {}, "queue": "nobody", **values}
        return (await create_job(connection, ProcrastinateQueue(), NewJob(**fields))).id


async def make_dataset(database: str, name: str, size_bytes: int = 5_000_000) -> uuid.UUID:
    async with open_pool(database, max_size=1, wait_seconds=10) as pool, pool.connection() as connection:
        made = await create_dataset(connection, "local", name, "photographs")
        await put_file(connection, made.id, "images/a.jpg", "0" * 64, size_bytes)
        return made.id


def names_in(page: str) -> list[str]:
    return re.findall(r'<a id="name-[^"]*" href="[^"]*">([^<]*)</a>', page)


async def test_jobs_are_found_by_label_dataset_kind_and_end_of_id(
    connect_service: ConnectService, database: str
) -> None:
    async with connect_service() as (http, _):
        dataset = await make_dataset(database, "Garden gate")
        gate = await make_job(database, dataset_id=dataset)
        await make_job(database, label="100% fox")
        await make_job(database, label="a render", kind="render")
        for text, wanted in (
            ("FOX", ["100% fox"]),
            ("100%", ["100% fox"]),
            ("gate", ["Garden gate"]),
            ("render", ["a render"]),
            (str(gate)[-8:], ["Garden gate"]),
            ("nothing such", []),
        ):
            page = (await http.get("/", params={"q": text})).text
            assert names_in(page) == wanted, text
            assert f'value="{html.escape(text)}"' in page
        part = (await http.get("/parts/jobs", params={"q": "fox", "show": "active"})).text
        assert 'href="/?show=done&amp;q=fox"' in part
        assert names_in(part) == ["100% fox"] and "/parts/jobs?show=active&amp;q=fox" in part


async def test_jobs_are_sorted_narrowed_to_a_kind_and_renamed(
    connect_service: ConnectService, database: str
) -> None:
    async with connect_service() as (http, _):
        scores = {"sort b": 20.0, "sort c": None, "Sort a": 31.5, "sort d": 25.0}
        ids = {name: await make_job(database, label=name, kind="render") for name in scores}
        async with open_pool(database, max_size=1, wait_seconds=10) as pool, pool.connection() as connection:
            for name, psnr in scores.items():
                await connection.execute("UPDATE jobs SET psnr = %s WHERE id = %s", [psnr, ids[name]])
        for order, wanted in (
            ("newest", ["sort d", "Sort a", "sort c", "sort b"]),
            ("oldest", ["sort b", "sort c", "Sort a", "sort d"]),
            ("name", ["Sort a", "sort b", "sort c", "sort d"]),
            ("psnr", ["Sort a", "sort d", "sort b", "sort c"]),
        ):
            page = await http.get("/", params={"q": "sort", "order": order})
            assert names_in(page.text) == wanted, order
            found: list[str] = []
            cursor: dict[str, str] = {}
            for _part in range(9):  # part by part over HTTP, all kinds of jobs among them
                query = {"kind": "render", "order": order, "limit": 1, **cursor}
                part = (await http.get("/v1/jobs", params=query)).json()
                found += [job["label"] for job in part["jobs"] if job["label"] in scores]
                if part["next"] is None:
                    break
                cursor = {"cursor": part["next"]}
            assert found == wanted, order
        assert names_in((await http.get("/", params={"q": "sort", "kind": "reconstruct"})).text) == []
        part = (await http.get("/parts/jobs", params={"kind": "render", "order": "psnr"})).text
        assert 'href="/?show=done&amp;kind=render&amp;order=psnr"' in part
        done = await http.post(
            f"/jobs/{ids['sort b']}/label", data={"label": "  sort <z> "}, follow_redirects=False
        )
        assert done.status_code == 303
        assert (await http.get(f"/v1/jobs/{ids['sort b']}")).json()["label"] == "sort <z>"
        await http.post(f"/jobs/{ids['sort b']}/label", data={"label": " "})
        assert (await http.get(f"/v1/jobs/{ids['sort b']}")).json()["label"] is None


async def test_chosen_jobs_are_cancelled_and_deleted(connect_service: ConnectService, database: str) -> None:
    async with connect_service() as (http, _):
        ids = [await make_job(database, label=f"job {k}") for k in range(3)]
        form = {"job": [str(ids[0]), str(ids[1])]}
        done = await http.post("/jobs/chosen?do=cancel", data=form, follow_redirects=False)
        assert done.status_code == 303
        states = [(await http.get(f"/v1/jobs/{one}")).json()["state"] for one in ids]
        assert states == ["canceled", "canceled", "queued"]
        done = await http.post("/jobs/chosen?do=delete", data=form, follow_redirects=False)
        assert done.status_code == 303
        assert [(await http.get(f"/v1/jobs/{one}")).status_code for one in ids] == [404, 404, 200]
        refused = await http.post("/jobs/chosen?do=delete", data={"job": [str(ids[0]), "fox"]})
        assert refused.status_code == 409
        assert "There is no such job." in refused.text and "fox is no id" in refused.text


async def test_error_of_an_action_is_not_told_as_wrong_id(
    connect_service: ConnectService, database: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def fail(*_: object) -> None:
        raise ValueError("something else")

    monkeypatch.setattr(job_actions, "cancel_job", fail)
    async with connect_service() as (http, _):
        with pytest.raises(ValueError, match="something else"):
            await http.post("/jobs/chosen?do=cancel", data={"job": [str(await make_job(database))]})


async def test_pictures_of_jobs_have_quoted_addresses(connect_service: ConnectService, database: str) -> None:
    async with connect_service() as (http, _):
        job_id = await make_job(database, kind="render")
        async with open_pool(database, max_size=1, wait_seconds=10) as pool, pool.connection() as connection:
            for name, media_type in (("renders/50% #1.png", "image/png"), ("orbit #1.mp4", "video/mp4")):
                await connection.execute(
                    "INSERT INTO artifacts (job_id, name, sha256, size_bytes, media_type) "
                    "VALUES (%s, %s, %s, 1, %s)",
                    [job_id, name, "0" * 64, media_type],
                )
        artifacts = f"/v1/jobs/{job_id}/artifacts"
        assert f'src="{artifacts}/renders/50%25%20%231.png"' in (await http.get("/")).text
        page = (await http.get(f"/jobs/{job_id}")).text
        assert (
            f'src="{artifacts}/orbit%20%231.mp4"' in page and f'href="{artifacts}/orbit%20%231.mp4"' in page
        )


async def test_variants_are_compared_by_the_settings_that_differ(
    connect_service: ConnectService, database: str
) -> None:
    assert differing_settings([{"a": 1, "b": {"c": 2}}, {"a": 1, "b": {"c": 3}, "d": "x"}]) == [
        ("b.c", ["2", "3"]),
        ("d", ["–", "x"]),
    ]
    async with connect_service() as (http, _):
        one = await make_job(database, label="coarse", options={"preset": "fast", "max_side": 320})
        two = await make_job(database, label="fine", options={"preset": "fast", "max_side": 640})
        page = await http.get("/compare", params={"job": [str(one), str(two)]})
        assert page.status_code == 200
        assert "<code>max_side</code>" in page.text and "<code>preset</code>" not in page.text
        assert "coarse" in page.text and "640" in page.text
        assert "Choose two or more jobs" in (await http.get("/compare")).text
        missing = await http.get("/compare", params={"job": [str(one), str(uuid.uuid4())]})
        assert missing.status_code == 404 and "text/html" in missing.headers["content-type"]


async def test_datasets_are_listed_with_their_size_and_deleted(
    connect_service: ConnectService, database: str
) -> None:
    async with connect_service() as (http, _):
        dataset = await make_dataset(database, "<b>chair", 2_500_000)
        used = await make_dataset(database, "in use")
        await make_job(database, dataset_id=used)
        page = (await http.get("/datasets")).text
        assert "&lt;b&gt;chair" in page and "<b>chair" not in page and "2.5 MB" in page
        refused = await http.post(f"/datasets/{used}/delete")
        assert refused.status_code == 409 and "text/html" in refused.headers["content-type"]
        done = await http.post(f"/datasets/{dataset}/delete", follow_redirects=False)
        assert done.status_code == 303
        assert "chair" not in (await http.get("/datasets")).text


async def test_queues_and_workers_are_for_administrators_only(
    connect_service: ConnectService, database: str
) -> None:
    async with connect_service() as (http, _):
        page = (await http.get("/usage")).text
        assert "Unfinished jobs" in page and "Queues" in page and 'href="/admin"' in page
        assert "Workers</h2>" in (await http.get("/admin")).text
        async with open_pool(database, max_size=1, wait_seconds=10) as pool, pool.connection() as connection:
            secret = "anna-" + uuid.uuid4().hex
            await add_token(connection, secret, owner="anna", name="anna", scopes=("write",))
        page = (await http.get("/usage", headers={"Authorization": f"Bearer {secret}"})).text
        assert "<b>anna</b>" in page and 'href="/admin"' not in page
        for method, path in (("GET", "/admin"), ("POST", "/admin/queues/cpu?paused=true")):
            refused = await http.request(method, path, headers={"Authorization": f"Bearer {secret}"})
            assert refused.status_code == 403, path


async def test_queue_is_paused_and_worker_drained_on_the_page(
    connect_service: ConnectService, database: str
) -> None:
    async with connect_service() as (http, _):
        job = await make_job(database, label="waits", queue="night")
        async with open_pool(database, max_size=1, wait_seconds=10) as pool, pool.connection() as connection:
            await record_worker_heartbeat(
                connection, uuid.uuid4(), name="box 1", queues=["night"], slots=2, facts={}
            )
        done = await http.post("/admin/queues/night?paused=true", follow_redirects=False)
        assert (done.status_code, done.headers["location"]) == (303, "/admin")
        await http.post("/admin/workers/box 1?drained=true", follow_redirects=False)
        found = (await http.get("/v1/queues")).json()
        assert [row["queue"] for row in found["queues"] if row["paused"]] == ["night"]
        assert [(row["name"], row["drained"]) for row in found["workers"]] == [("box 1", True)]
        page = (await http.get("/admin")).text
        assert "Let go on the queue night" in page and "Let take jobs: the worker box 1" in page
        notes = (await http.get(f"/v1/jobs/{job}")).json()["notes"]
        assert notes[0] == "An administrator has paused the queue night; the job waits until it goes on."
        await http.post("/admin/queues/night?paused=false")
        notes = (await http.get(f"/v1/jobs/{job}")).json()["notes"]
        assert "All workers of the queue night are being drained; the job waits for another one." in notes
        gone = await http.patch("/v1/workers/nobody", json={"drained": True})
        assert gone.status_code == 404


async def test_worker_whose_name_holds_a_slash_is_drained(
    connect_service: ConnectService, database: str
) -> None:
    async with connect_service() as (http, _):
        async with open_pool(database, max_size=1, wait_seconds=10) as pool, pool.connection() as connection:
            await record_worker_heartbeat(
                connection, uuid.uuid4(), name="rack/box", queues=["night"], slots=2, facts={}
            )
        action = re.search(r'action="(/admin/workers/rack[^"]*)"', (await http.get("/admin")).text)
        assert action is not None
        done = await http.post(action[1], follow_redirects=False)
        assert (done.status_code, done.headers["location"]) == (303, "/admin")
        drained = await http.patch("/v1/workers/rack%2Fbox", json={"drained": False})
        assert drained.status_code == 200 and drained.json()["name"] == "rack/box"


async def test_form_of_a_new_job_has_the_settings_of_another(
    connect_service: ConnectService, database: str
) -> None:
    options = {"preset": "fast", "max_side": 320, "exports": ["viewer.glb"], "train": {"iterations": 700}}
    async with connect_service() as (http, _):
        job = await make_job(database, label='fox "one"', options=options)
        page = (await http.get("/new", params={"like": str(job)})).text
        given = re.search(r'data-given="([^"]*)"', page)
        assert given is not None
        filled = json.loads(html.unescape(given[1]))
        assert {name: filled[name] for name in ("preset", "max_side", "exports")} == {
            name: options[name] for name in ("preset", "max_side", "exports")
        }
        assert filled["train"]["iterations"] == 700
        assert 'value="fox &#34;one&#34;"' in page
        assert "data-given" not in (await http.get("/new")).text


async def test_unknown_addresses_are_pages_for_browsers_and_problems_for_programs(
    connect_service: ConnectService,
) -> None:
    async with connect_service() as (http, _):
        page = await http.get("/nothing/here", headers=BROWSER)
        assert page.status_code == 404 and "text/html" in page.headers["content-type"]
        assert "There is nothing at this address." in page.text and "To the jobs" in page.text
        for path, headers in (("/nothing", {"Accept": "application/json"}), ("/v1/nothing", BROWSER)):
            answer = await http.get(path, headers=headers)
            assert answer.status_code == 404
            assert answer.headers["content-type"] == "application/problem+json"
