"""What HTTP promises: ranges, ETags, keys against repetition, strict queries, rights of readers."""

import uuid

import pytest

from octasplat.service.app import create_app
from octasplat.service.settings import ServiceSettings
from octasplat.workers.db.holds import set_worker_drained
from octasplat.workers.db.workers import record_worker_heartbeat
from octasplat.workers.queue.job_results import ResultFile
from tests.support.api_inventory import operations
from tests.support.service_harness import (
    ConnectService,
    claim_job,
    client_with_token,
    committed_dataset,
    new_job,
    store_content,
)

CONTENT = bytes(range(256)) * 4


async def finished_job(http, service) -> str:  # type: ignore[no-untyped-def]
    job = await new_job(http, service)
    attempt = await claim_job(service, job)
    sha256 = store_content(service, CONTENT)
    await attempt.succeed([ResultFile("a.bin", sha256, len(CONTENT), "application/octet-stream")])
    return str(job["id"])


@pytest.mark.parametrize("is_remote", [False, True])
async def test_ranges_are_answered_as_rfc_9110_asks(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch, is_remote: bool
) -> None:
    async with connect_service() as (http, service):
        address = f"/v1/jobs/{await finished_job(http, service)}/artifacts/a.bin"
        if is_remote:
            monkeypatch.setattr(type(service.storage), "local_path", lambda _self, _sha256: None)

        async def get(text: str, **headers: str):  # type: ignore[no-untyped-def]
            return await http.get(address, headers={"Range": text, **headers})

        part = await get("bytes=10-19")
        assert (part.status_code, part.content) == (206, CONTENT[10:20])
        assert part.headers["Content-Range"] == "bytes 10-19/1024"
        assert (await get("bytes=-4")).content == CONTENT[-4:]
        assert (await get("BYTES=1020-9999")).content == CONTENT[1020:]
        for ignored in ("lines=1-2", "items", "bytes-ish=0-1"):
            whole = await get(ignored)
            assert (whole.status_code, whole.content) == (200, CONTENT), ignored
        assert (await get("bytes=0-1", **{"If-Range": '"another"'})).status_code == 200
        assert (await get("bytes=5000-", **{"If-Range": '"another"'})).status_code == 200
        for text in ("bytes=10-19", "bytes=5000-", "bytes=9-3"):  # ranges are those of GET
            head = await http.head(address, headers={"Range": text})
            assert (head.status_code, head.headers["Content-Length"]) == (200, "1024"), text
        for behind in ("bytes=1024-", "bytes=5000-6000", "bytes=-0"):
            refused = await get(behind)
            assert (refused.status_code, refused.json()["type"]) == (416, "urn:octasplat:problem:range"), (
                behind
            )
            assert refused.headers["Content-Type"] == "application/problem+json"
            assert refused.headers["Content-Range"] == "bytes */1024"
        for malformed in ("bytes=", "bytes", "bytes=a-b", "bytes=9-3", "bytes=1"):
            refused = await get(malformed)
            assert (refused.status_code, refused.json()["status"]) == (400, 400), malformed
            assert refused.headers["Content-Type"] == "application/problem+json"
        several = await get("bytes=0-1,4-5,9000-")
        if is_remote:
            assert (several.status_code, several.content) == (200, CONTENT)
        else:
            assert several.status_code == 206 and several.content.count(b"Content-Range: bytes") == 2


async def test_unknown_query_parameters_are_refused_by_name(connect_service: ConnectService) -> None:
    async with connect_service() as (http, _service):
        for address, unknown in (
            ("/v1/jobs?stat=running&limit=3", ["stat"]),
            ("/v1/datasets?offset=3&page=2&offset=4", ["offset", "page"]),
            ("/v1/info?verbose", []),
            ("/v1/info?verbose=", ["verbose"]),
            ("/healthz?x=1", ["x"]),
        ):
            answer = await http.get(address)
            named = [error["parameter"] for error in answer.json().get("errors", ())]
            assert named == unknown or (not unknown and named == ["verbose"]), answer.text
            assert (answer.status_code, answer.headers["content-type"]) == (422, "application/problem+json")
        assert "limit" in (await http.get("/v1/jobs?stat=1")).json()["detail"]
        assert (await http.get("/v1/jobs?state=running&state=failed&limit=3")).status_code == 200
        assert (await http.get("/?anything=1")).status_code == 200  # pages are no part of the API


async def test_every_post_declares_the_idempotency_key() -> None:
    posts = [o for o in operations(create_app(ServiceSettings())) if o.method == "POST"]
    assert len(posts) >= 12
    for operation in posts:
        names = [parameter["name"] for parameter in operation.described.get("parameters", ())]
        assert "Idempotency-Key" in names, operation.name


async def test_repeated_posts_make_nothing_new(connect_service: ConnectService) -> None:
    async with connect_service() as (http, _service):
        once = {"Idempotency-Key": "hook"}
        body = {"url": "https://example.org/hook"}
        first = await http.post("/v1/webhooks", json=body, headers=once)
        again = await http.post("/v1/webhooks", json=body, headers=once)
        assert first.status_code == again.status_code == 201 and first.json() == again.json()
        assert len((await http.get("/v1/webhooks")).json()["webhooks"]) == 1
        other = await http.post("/v1/webhooks", json={"url": "https://example.org/x"}, headers=once)
        assert other.json()["type"].endswith(":idempotency-key")
        address = f"/v1/webhooks/{first.json()['id']}"
        sent = [await http.post(f"{address}/test", headers={"Idempotency-Key": "test"}) for _ in range(2)]
        assert sent[0].json()["id"] == sent[1].json()["id"] and sent[1].status_code == 202
        message = f"{address}/deliveries/{sent[0].json()['id']}/redeliver"
        for _ in range(2):
            answer = await http.post(message, headers={"Idempotency-Key": "message"})
            assert answer.status_code == 202
        assert len((await http.get(f"{address}/deliveries")).json()["deliveries"]) == 1
        await http.delete(address)
        assert (await http.post("/v1/webhooks", json=body, headers=once)).status_code == 404

        token = {"name": "n", "owner": "me", "scopes": ["read"]}
        made = await http.post("/v1/tokens", json=token, headers={"Idempotency-Key": "token"})
        before = (await http.get("/v1/tokens")).json()
        repeated = await http.post("/v1/tokens", json=token, headers={"Idempotency-Key": "token"})
        assert (repeated.status_code, repeated.json()["type"]) == (409, "urn:octasplat:problem:secret-shown")
        assert made.json()["id"] in repeated.text and made.json()["token"] not in repeated.text
        assert (await http.get("/v1/tokens")).json() == before
        link = [await http.post("/v1/sign-in-links", headers={"Idempotency-Key": "l"}) for _ in range(2)]
        assert [answer.status_code for answer in link] == [201, 409]


async def test_repeated_cancel_leaves_a_retried_job_alone(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        address = f"/v1/jobs/{(await new_job(http, service))['id']}"
        key = {"Idempotency-Key": "c"}
        assert (await http.post(f"{address}/cancel", headers=key)).json()["state"] == "canceled"
        assert (await http.post(f"{address}/retry")).json()["state"] == "queued"
        assert (await http.post(f"{address}/cancel", headers=key)).json()["state"] == "queued"
        assert (await http.post(f"{address}/cancel")).json()["state"] == "canceled"


async def test_changes_give_the_etag_that_the_next_change_needs(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        job = await new_job(http, service)
        dataset = (await http.post("/v1/datasets", json={"name": "a"})).json()
        hook = (await http.post("/v1/webhooks", json={"url": "https://example.org/hook"})).json()
        token = (await http.post("/v1/tokens", json={"name": "a", "owner": "me", "scopes": ["read"]})).json()
        for address, changes in (
            (f"/v1/jobs/{job['id']}", [{"label": "a"}, {"pinned": True}]),
            (f"/v1/datasets/{dataset['id']}", [{"name": "b"}, {"pinned": True}]),
            (f"/v1/webhooks/{hook['id']}", [{"enabled": False}, {"enabled": True}]),
            (f"/v1/tokens/{token['id']}", [{"name": "b"}, {"name": "c"}]),
        ):
            first = (await http.get(address)).headers["ETag"]
            changed = await http.patch(address, json=changes[0], headers={"If-Match": first})
            assert changed.status_code == 200 and changed.headers["ETag"] != first, address
            seen = await http.get(address, headers={"If-None-Match": changed.headers["ETag"]})
            assert seen.status_code == 304, address
            others = ", ".join(f'"{k}"' for k in range(500))  # however many a cache has kept
            seen = await http.get(address, headers={"If-None-Match": f"{others}, {changed.headers['ETag']}"})
            assert seen.status_code == 304, address
            stale = await http.patch(address, json=changes[1], headers={"If-Match": first})
            assert (stale.status_code, stale.json()["type"]) == (412, "urn:octasplat:problem:precondition")
            fresh = await http.patch(address, json=changes[1], headers={"If-Match": changed.headers["ETag"]})
            assert fresh.status_code == 200, fresh.text


async def test_etag_of_waiting_job_changes_with_text_of_notes(
    connect_service: ConnectService,
) -> None:
    async with connect_service() as (http, service):
        address = f"/v1/jobs/{(await new_job(http, service))['id']}"
        first = await http.get(address)
        facts = {"name": "a", "queues": [first.json()["queue"]], "slots": 1, "facts": {}}
        async with service.pool.connection() as connection:
            await record_worker_heartbeat(connection, uuid.uuid4(), **facts)
            await set_worker_drained(connection, "a", True)
        second = await http.get(address, headers={"If-None-Match": first.headers["ETag"]})
        assert second.status_code == 200
        notes = [answer.json()["notes"] for answer in (first, second)]
        assert [len(texts) for texts in notes] == [1, 1] and notes[0] != notes[1]
        again = await http.get(address, headers={"If-None-Match": second.headers["ETag"]})
        assert again.status_code == 304


async def test_owners_see_narrow_and_revoke_their_tokens(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        made = await http.post("/v1/tokens", json={"name": "a", "owner": "me", "scopes": ["write"]})
        address, token_id = made.headers["Location"], made.json()["id"]
        assert (await http.get(address)).json()["id"] == token_id
        mine = {"Authorization": f"Bearer {made.json()['token']}"}
        stranger = await client_with_token(service, "stranger", "write")
        boss = await http.post("/v1/tokens", json={"name": "b", "owner": "me", "scopes": ["admin"]})
        listed = (await http.get("/v1/tokens", headers=mine)).json()["tokens"]
        assert {token["id"] for token in listed} == {token_id, boss.json()["id"]}
        assert [
            token["owner"] for token in (await http.get("/v1/tokens", headers=stranger)).json()["tokens"]
        ] == ["stranger"]
        for method in ("GET", "PATCH", "DELETE"):
            body = {"json": {"name": "x"}} if method == "PATCH" else {}
            assert (await http.request(method, address, headers=stranger, **body)).status_code == 404
        stronger = await http.delete(boss.headers["Location"], headers=mine)
        assert (stronger.status_code, stronger.json()["type"]) == (403, "urn:octasplat:problem:scope")
        wider = await http.patch(address, json={"scopes": ["write", "admin"]}, headers=mine)
        assert (wider.status_code, wider.json()["errors"][0]["pointer"]) == (422, "#/scopes")
        ends = {"scopes": ["read"], "expires_at": "2100-01-01T00:00:00Z"}
        narrow = await http.patch(address, json=ends, headers=mine)
        assert (narrow.json()["scopes"], narrow.json()["expires_at"]) == (["read"], "2100-01-01T00:00:00Z")
        assert (await http.post("/v1/datasets", json={}, headers=mine)).status_code == 403
        later = await http.patch(address, json={"expires_at": "2101-01-01T00:00:00Z"})
        assert (later.status_code, later.json()["errors"][0]["pointer"]) == (422, "#/expires_at")
        own = await client_with_token(service, "me", "write")
        assert (await http.delete(address, headers=own)).status_code == 204
        assert (await http.get("/v1/info", headers=mine)).status_code == 401
        assert (await http.patch(address, json={"name": "x"})).status_code == 409


async def test_readers_estimate_but_hear_nothing_of_hosts_and_others(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        reader = await client_with_token(service, "me", "read")
        monitor = await client_with_token(service, "watch", "metrics")
        photographs = [{"width_px": 640, "height_px": 480, "count": 20}]
        estimate = await http.post("/v1/estimates", json={"photographs": photographs}, headers=reader)
        assert estimate.status_code == 200 and estimate.json()["estimate"]["seconds"] > 0
        async with service.pool.connection() as connection:
            await record_worker_heartbeat(
                connection,
                uuid.uuid4(),
                name="secret-host-1",
                queues=["cpu"],
                slots=2,
                facts={"host": "secret"},
            )
        await new_job(http, service)
        mine = {"kind": "toy", "dataset_id": await committed_dataset(service, "me")}
        writer = await client_with_token(service, "me", "write")
        job = (await http.post("/v1/jobs", json=mine, headers=writer)).json()
        await claim_job(service, job)
        queues = (await http.get("/v1/queues", headers=reader)).json()
        assert queues["workers"] == []
        assert [(q["waiting"], q["running"], q["slots"]) for q in queues["queues"]] == [(0, 1, 2)]
        assert (await http.get("/v1/queues")).json()["workers"][0]["name"] == "secret-host-1"
        assert (await http.get("/v1/queues")).json()["queues"][0]["waiting"] == 1
        address = f"/v1/jobs/{job['id']}"
        assert (await http.get(address)).json()["worker"] == "w"
        for path in (address, "/v1/jobs"):
            found = (await http.get(path, headers=reader)).json()
            assert found.get("jobs", [found])[0]["worker"] is None
        events = (await http.get(f"{address}/timeline", headers=reader)).json()["events"]
        assert [e["data"] for e in events if e["data"].get("state") == "running"] == [{"state": "running"}]
        assert [e["data"].get("worker") for e in (await http.get(f"{address}/timeline")).json()["events"]][
            -1
        ] == "w"
        assert " w" not in (await http.get(f"{address}/logs", headers=reader)).text
        for headers, status in ((reader, 403), (writer, 403), (monitor, 200)):
            assert (await http.get("/metrics", headers=headers)).status_code == status
        for path in ("/v1/jobs", "/v1/info", "/v1/queues", "/v1/tokens"):
            assert (await http.get(path, headers=monitor)).status_code == 403


async def test_bodies_that_cannot_be_read_are_refused_in_words_of_http(
    connect_service: ConnectService,
) -> None:
    async with connect_service() as (http, _service):
        # curl -d without a header
        form = await http.post(
            "/v1/jobs",
            content=b'{"kind": "info"}',
            headers={"Content-Type": "application/x-www-form-urlencoded"},
        )
        (fault,) = form.json()["errors"]
        assert form.status_code == 422 and fault["pointer"] == "#"
        assert (
            fault["detail"] == "The body is read as JSON only with the header Content-Type: application/json"
        )
        broken = await http.post(
            "/v1/jobs", content=b'{"dataset_id": ', headers={"Content-Type": "application/json"}
        )
        (fault,) = broken.json()["errors"]
        assert fault["pointer"] == "#"
        assert fault["detail"] == "The body is no JSON: Expecting value at character 15"
        unknown = await http.post("/v1/jobs", json={"dataset": str(uuid.uuid4())})
        (fault,) = unknown.json()["errors"]
        assert fault == {
            "code": "extra_forbidden", "detail": "There is no field 'dataset' here", "pointer": "#/dataset",
        }  # fmt: skip
        option = await http.post("/v1/estimates", json={"kind": "render", "options": {"frame": 60}})
        (fault,) = option.json()["errors"]
        assert fault["detail"] == "There is no such option; the nearest is frames"
        assert fault["pointer"] == "#/options/frame"


async def test_refused_method_is_answered_with_all_that_the_address_takes(
    connect_service: ConnectService,
) -> None:
    async with connect_service() as (http, _service):
        for address, methods in (
            ("/v1/jobs", "GET, POST"),
            (f"/v1/jobs/{uuid.uuid4()}", "DELETE, GET, PATCH"),
            ("/v1/info", "GET"),
        ):
            refused = await http.put(address)
            assert (refused.status_code, refused.headers["Allow"]) == (405, methods), address
