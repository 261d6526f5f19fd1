"""A large file goes on after its client, its connection or the service was killed in the middle."""

import asyncio
import base64
import hashlib
import io
import subprocess
import sys
import threading
import time
import uuid
import zipfile
from collections.abc import AsyncIterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psycopg
import pytest
from PIL import Image

from octasplat.service.actions import resumable_uploads, task_runner, uploads
from octasplat.service.intake import receive
from octasplat.service.state import Service
from octasplat.workers.client.api import Api
from octasplat.workers.client.upload import upload_scene
from octasplat.workers.client.upload_parts import PARALLEL_PARTS
from octasplat.workers.db.dataset_tasks import DatasetTask
from octasplat.workers.db.quotas import Quota, set_quota
from octasplat.workers.db.uploads import FileUpload, delete_upload
from octasplat.workers.maintenance.garbage_collection import collect_garbage_now
from octasplat.workers.maintenance.retention import apply_retention
from octasplat.workers.settings import Retention
from tests.support.front_end import FrontEnd
from tests.support.model_builder import ColmapModelBuilder, photographs
from tests.support.service_harness import ConnectService, client_with_token, task_over
from tests.support.zip_builder import ZipMember, build_zip

TUS = {"Tus-Resumable": "1.0.0"}
PART = {**TUS, "Content-Type": "application/offset+octet-stream"}
PICTURE = next(iter(photographs().values()))


def announced(size: int, **told: str) -> dict[str, str]:
    pairs = (f"{name} {base64.b64encode(value.encode()).decode()}" for name, value in told.items())
    return {**TUS, "Upload-Length": str(size), "Upload-Metadata": ",".join(pairs)}


async def new_dataset(http: httpx.AsyncClient, **headers: str) -> str:
    return str((await http.post("/v1/datasets", json={"name": "d"}, headers=headers)).headers["Location"])


async def new_upload(http: httpx.AsyncClient, dataset: str, content: bytes, **told: str) -> str:
    answer = await http.post(f"{dataset}/uploads", headers=announced(len(content), **told))
    assert answer.status_code == 201, answer.text
    return str(answer.headers["Location"])


async def send(http: httpx.AsyncClient, upload: str, offset: int, content: bytes) -> httpx.Response:
    return await http.patch(upload, content=content, headers={**PART, "Upload-Offset": str(offset)})


async def test_file_comes_in_parts_as_tus_has_it(connect_service: ConnectService) -> None:
    async with connect_service() as (http, _):
        dataset = await new_dataset(http)
        digest = hashlib.sha256(PICTURE).hexdigest()
        upload = await new_upload(http, dataset, PICTURE, path="images/a.png", sha256=digest)
        half = len(PICTURE) // 2
        first = await send(http, upload, 0, PICTURE[:half])
        assert (first.status_code, first.headers["Upload-Offset"]) == (204, str(half))
        told = await http.head(upload, headers=TUS)
        assert told.status_code == 200 and told.headers["Cache-Control"] == "no-store"
        assert (told.headers["Upload-Offset"], told.headers["Upload-Length"]) == (
            str(half),
            str(len(PICTURE)),
        )
        assert told.headers["Tus-Resumable"] == "1.0.0" and told.headers["Upload-Expires"].endswith("GMT")
        assert (await http.get(upload)).json()["offset_bytes"] == half
        assert (await send(http, upload, 0, PICTURE[:half])).status_code == 409
        assert (await send(http, upload, half, PICTURE)).status_code == 413
        other = await http.head(upload, headers={"Tus-Resumable": "0.2.2"})
        assert (other.status_code, other.headers["Tus-Version"]) == (412, "1.0.0")
        plain = await http.patch(upload, content=b"x", headers={**TUS, "Upload-Offset": str(half)})
        assert plain.status_code == 415
        reached = int((await http.head(upload)).headers["Upload-Offset"])
        last = await send(http, upload, reached, PICTURE[reached:])
        assert last.status_code == 204 and last.headers["Upload-Offset"] == str(len(PICTURE))
        task = await task_over(http, httpx.Response(202, headers={"Location": last.headers["Location"]}))
        assert (task["kind"], task["result"]) == ("upload", {"files": 1, "left_out": [], "notes": []})
        assert (await http.get(f"{dataset}/files/images/a.png")).content == PICTURE
        assert (await http.head(upload)).status_code == 404


async def test_archive_comes_in_parts_and_is_unpacked(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(receive, "PIECE_BYTES", 1000)
    monkeypatch.setattr(receive, "PART_BYTES", 5000)
    scene = {**photographs(), **ColmapModelBuilder().files()}
    archive = build_zip(*(ZipMember(name, content) for name, content in scene.items()))
    async with connect_service() as (http, service):
        dataset = await new_dataset(http)
        upload = await new_upload(http, dataset, archive)
        last = await send(http, upload, 0, archive)
        async with service.pool.connection() as connection:
            cursor = await connection.execute("SELECT count(*) AS n FROM upload_parts")
            row = await cursor.fetchone()
        assert row is not None and (row["n"] == 0 or row["n"] >= len(archive) // 5000)
        task = await task_over(http, httpx.Response(202, headers={"Location": last.headers["Location"]}))
        assert task["state"] == "succeeded" and task["result"]["files"] == len(scene), task
        assert (await http.post(f"{dataset}/commit")).status_code == 200


async def put_part(
    http: httpx.AsyncClient, upload: str, start: int, content: bytes, announced_as: bytes | None = None
) -> httpx.Response:
    digest = base64.b64encode(hashlib.sha256(announced_as or content).digest()).decode()
    headers = {"Repr-Digest": f"sha-256=:{digest}:"}
    return await http.put(f"{upload}/parts/{start}", content=content, headers=headers)


async def test_parts_come_in_any_order_and_at_once(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(receive, "PARALLEL_PART_BYTES", 500)
    scene = {**photographs(), **ColmapModelBuilder().files()}
    archive = build_zip(*(ZipMember(name, content, method=0) for name, content in scene.items()))
    starts = range(0, len(archive), 500)
    assert len(starts) > 3
    parts = {start: archive[start : start + 500] for start in starts}
    async with connect_service() as (http, _):
        dataset = await new_dataset(http)
        upload = await new_upload(http, dataset, archive, sha256=hashlib.sha256(archive).hexdigest())
        wrong = await put_part(http, upload, 500, parts[500], b"other")
        assert (wrong.status_code, wrong.json()["type"]) == (422, "urn:octasplat:problem:digest-mismatch")
        assert wrong.json()["detail"].count(". ") == 0
        last = await asyncio.gather(*(put_part(http, upload, start, parts[start]) for start in starts[2:]))
        assert {(a.status_code, a.headers["Upload-Offset"], a.headers.get("Location")) for a in last} == {
            (204, "0", None)
        }
        assert (await put_part(http, upload, 1000, parts[1000])).status_code == 204  # its answer was lost
        told = (await http.get(upload)).json()
        assert (told["part_bytes"], told["offset_bytes"], told["parts_ahead"]) == (500, 0, list(starts[2:]))
        assert (await http.get("/v1/usage")).json()["bytes"]["used"] == len(archive) - 1000
        assert (await put_part(http, upload, 0, parts[0])).headers["Upload-Offset"] == "500"
        other = await put_part(http, upload, 0, bytes(500))
        assert (other.status_code, other.json()["type"]) == (409, "urn:octasplat:problem:conflict")
        whole = await put_part(http, upload, 500, parts[500])
        assert whole.headers["Upload-Offset"] == str(len(archive))
        answer = httpx.Response(202, headers={"Location": whole.headers["Location"]})
        assert (await task_over(http, answer))["state"] == "succeeded"
        assert (await http.post(f"{dataset}/commit")).json()["has_poses"]


async def test_front_end_of_the_former_version_writes_over_parts_that_came_ahead(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It knows nothing of them, and leaves them there."""
    monkeypatch.setattr(receive, "PARALLEL_PART_BYTES", 20)
    digest = hashlib.sha256(PICTURE).hexdigest()
    async with connect_service() as (http, service):
        dataset = await new_dataset(http)
        upload = await new_upload(http, dataset, PICTURE, path="images/a.png", sha256=digest)
        for start in (0, 40):
            assert (await send(http, upload, start, PICTURE[start : start + 40])).status_code == 204
        async with service.pool.connection() as connection:
            await connection.execute(
                """
                INSERT INTO upload_parts (upload_id, start_bytes, owner, sha256, size_bytes)
                SELECT id, ahead.start, owner, ahead.digest, 20
                FROM uploads CROSS JOIN unnest(%s::bigint[], %s::text[]) AS ahead (start, digest)
                """,
                [[20, 60], [hashlib.sha256(PICTURE[s : s + 20]).hexdigest() for s in (20, 60)]],
            )
        last = await send(http, upload, 80, PICTURE[80:])
        task = await task_over(http, httpx.Response(202, headers={"Location": last.headers["Location"]}))
        assert task["state"] == "succeeded", task
        assert (await http.get(f"{dataset}/files/images/a.png")).content == PICTURE


async def test_upload_that_is_stored_while_it_is_asked_for_is_found(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Or the file would be sent again, as that of an upload that is over."""
    create = resumable_uploads.create_upload

    async def create_and_store(service: Service, *asked: Any, **named: Any) -> FileUpload:
        upload = await create(service, *asked, **named)
        async with service.pool.connection() as connection:
            await delete_upload(connection, upload)
        return upload

    monkeypatch.setattr(resumable_uploads, "create_upload", create_and_store)
    async with connect_service() as (http, _):
        dataset = await new_dataset(http)
        upload = await new_upload(http, dataset, PICTURE, path="images/a.png")
        assert (await http.get(upload)).status_code == 404


async def test_part_that_does_not_fit_is_refused(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(receive, "PARALLEL_PART_BYTES", 1000)
    content = bytes(2500)
    async with connect_service(quota_bytes=2500) as (http, service):
        dataset = await new_dataset(http)
        plain = await new_upload(http, dataset, content, path="images/a.png")
        upload = await new_upload(
            http, dataset, content, path="images/a.png", sha256=hashlib.sha256(content).hexdigest()
        )
        assert (await put_part(http, plain, 0, content[:1000])).status_code == 409
        for start, part in ((500, content[:1000]), (3000, b""), (2000, content[:1000]), (0, content[:999])):
            assert (await put_part(http, upload, start, part)).status_code == 422, start
        assert (await http.put(f"{upload}/parts/0", content=content[:1000])).status_code == 422
        bob = await client_with_token(service, "bob", "write")
        digest = {"Repr-Digest": f"sha-256=:{base64.b64encode(hashlib.sha256(b'x').digest()).decode()}:"}
        foreign = await http.put(f"{upload}/parts/0", content=b"x", headers={**digest, **bob})
        assert foreign.status_code == 404
        assert (await http.get("/v1/usage")).json()["bytes"]["used"] == 0
        # As tus has it, what comes in order replaces what came ahead of it.
        assert (await put_part(http, upload, 2000, content[2000:])).status_code == 204
        assert (await send(http, upload, 0, content[:1700])).headers["Upload-Offset"] == "1700"
        assert (await http.get(upload)).json()["parts_ahead"] == []
        assert (await put_part(http, upload, 1000, content[1000:2000])).status_code == 409
        async with service.pool.connection() as connection:
            await set_quota(connection, "local", Quota(max_bytes=1))
        assert (await put_part(http, upload, 2000, content[2000:])).status_code == 413


async def test_what_has_come_of_a_body_that_breaks_off_is_kept(connect_service: ConnectService) -> None:
    async def broken() -> AsyncIterator[bytes]:
        yield b"x" * 1000
        raise receive.IntakeError(receive.IntakeFault("upload-stalled", "Nothing came."))

    async with connect_service() as (_, service):
        stored = []
        with pytest.raises(receive.IntakeError):
            async for blob in receive.receive_parts(service.storage, broken(), max_bytes=5000):
                stored.append(blob.size_bytes)
        assert stored == [1000]


async def test_refused_content_is_told_and_its_parts_go(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        dataset = await new_dataset(http)

        async def stored_bytes() -> int:
            return int((await http.get("/v1/usage")).json()["bytes"]["used"])

        for told, content, code in (
            ({"path": "images/a.png"}, b"no picture", "image"),
            ({"path": "images/a.png", "sha256": "0" * 64}, PICTURE, "digest-mismatch"),
            ({}, b"no archive", "archive"),
        ):
            upload = await new_upload(http, dataset, content, **told)  # type: ignore[arg-type]
            last = await send(http, upload, 0, content)
            task = await task_over(http, httpx.Response(202, headers={"Location": last.headers["Location"]}))
            assert task["state"] == "failed" and code in task["problem"]["type"], task
            assert (await http.head(upload)).status_code == 404 and await stored_bytes() == 0
        for headers in (
            announced(5, path="../a.png"), announced(0, path="images/a.png"), announced(1 << 50),
            {**announced(5), "Upload-Metadata": "path !!"}, announced(5, sha256="x"), TUS,
        ):  # fmt: skip
            assert (await http.post(f"{dataset}/uploads", headers=headers)).status_code in (413, 422), headers
        await collect_garbage_now(service.pool, service.storage, every_seconds=0)


async def test_parts_count_for_their_owner_and_are_not_collected(
    connect_service: ConnectService,
) -> None:
    async with connect_service(quota_bytes=3000) as (http, service):
        dataset = await new_dataset(http)
        content = bytes(2500)
        upload = await new_upload(http, dataset, content, path="images/a.png")
        assert (await send(http, upload, 0, content[:2000])).status_code == 204
        assert (await http.get("/v1/usage")).json()["bytes"]["used"] == 2000
        too_much = await http.post(f"{dataset}/uploads", headers=announced(2000, path="images/b.png"))
        assert too_much.status_code == 413
        async with service.pool.connection() as connection:
            await connection.execute("UPDATE installation SET collected_at = now() - interval '1 day'")
        await asyncio.sleep(2.5)  # what is younger is never collected
        await collect_garbage_now(service.pool, service.storage, every_seconds=0)
        assert [blob.blob.size_bytes for blob in service.storage.list_blobs()] == [2000]
        bob = await client_with_token(service, "bob", "write")
        for answer in (
            await http.head(upload, headers=bob), await http.delete(upload, headers=bob),
            await http.patch(upload, content=b"x", headers={**PART, **bob, "Upload-Offset": "2000"}),
        ):  # fmt: skip
            assert answer.status_code == 404
        async with service.pool.connection() as connection:
            await connection.execute("UPDATE uploads SET expires_at = now() - interval '1 hour'")
        await apply_retention(service.pool, Retention(), 1000.0)
        assert (await http.head(upload)).status_code == 404
        assert (await http.get("/v1/usage")).json()["bytes"]["used"] == 0
        again = await new_upload(http, dataset, content, path="images/a.png")
        await send(http, again, 0, content[:10])
        assert (await http.delete(dataset)).status_code == 204
        assert (await http.get("/v1/usage")).json()["bytes"]["used"] == 0


async def test_part_that_is_called_json_is_not_read_before_it_is_known_who_sends_it(
    connect_service: ConnectService,
) -> None:
    pieces = 0

    async def body() -> AsyncIterator[bytes]:
        nonlocal pieces
        for _ in range(200):
            pieces += 1
            yield b" " * 1000

    async with connect_service(signed_in=False) as (http, _):
        headers = {**PART, "Content-Type": "application/json", "Upload-Offset": "0"}
        address = f"/v1/datasets/{uuid.uuid4()}/uploads/{uuid.uuid4()}"
        assert (await http.patch(address, content=body(), headers=headers)).status_code == 401
        assert pieces < 5


async def test_upload_is_stored_while_the_service_ends_its_last_requests(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_upload = task_runner.run_upload

    async def run_when_draining(service: Service, task: DatasetTask) -> Any:
        service.is_draining = True
        return await run_upload(service, task)

    monkeypatch.setattr(task_runner, "run_upload", run_when_draining)
    async with connect_service() as (http, _):
        dataset = await new_dataset(http)
        upload = await new_upload(http, dataset, PICTURE, path="images/a.png")
        last = await send(http, upload, 0, PICTURE)
        task = await task_over(http, httpx.Response(202, headers={"Location": last.headers["Location"]}))
        assert task["state"] == "succeeded", task["problem"]


async def test_upload_whose_storing_was_given_up_is_begun_again_or_deleted(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def fail(*_: object) -> Any:
        raise RuntimeError("a fault of the service")

    async with connect_service() as (http, _):
        dataset = await new_dataset(http)
        with monkeypatch.context() as patch:
            patch.setattr(uploads, "store_named", fail)
            addresses = [await new_upload(http, dataset, PICTURE, path=f"images/{n}.png") for n in range(2)]
            for upload in addresses:
                last = await send(http, upload, 0, PICTURE)
                answer = httpx.Response(202, headers={"Location": last.headers["Location"]})
                assert (await task_over(http, answer))["state"] == "failed"
        again = await send(http, addresses[0], len(PICTURE), b"")
        task = await task_over(http, httpx.Response(202, headers={"Location": again.headers["Location"]}))
        assert task["state"] == "succeeded"
        assert (await http.delete(addresses[1])).status_code == 204
        listed = (await http.get(f"{dataset}/files")).json()["files"]
        assert [file["path"] for file in listed] == ["images/0.png"]


async def test_upload_that_meets_a_commit_is_kept_for_when_the_dataset_is_open_again(
    connect_service: ConnectService,
) -> None:
    async with connect_service() as (http, service):
        dataset = await new_dataset(http)
        upload = await new_upload(http, dataset, PICTURE, path="images/a.png")
        assert (await send(http, upload, 0, PICTURE[:-1])).status_code == 204

        async def close() -> AsyncIterator[bytes]:
            async with service.pool.connection() as connection:
                await connection.execute("UPDATE datasets SET state = 'checking'")
            yield PICTURE[-1:]

        headers = {**PART, "Upload-Offset": str(len(PICTURE) - 1)}
        last = await http.patch(upload, content=close(), headers=headers)
        task = await task_over(http, httpx.Response(202, headers={"Location": last.headers["Location"]}))
        assert (task["state"], task["problem"]["status"]) == ("failed", 409)
        async with service.pool.connection() as connection:
            await connection.execute("UPDATE datasets SET state = 'open'")
        last = await send(http, upload, len(PICTURE), b"")
        task = await task_over(http, httpx.Response(202, headers={"Location": last.headers["Location"]}))
        assert task["state"] == "succeeded"
        assert (await http.get(f"{dataset}/files/images/a.png")).content == PICTURE


async def test_upload_that_waits_to_be_stored_is_kept(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on, run_upload = asyncio.Event(), task_runner.run_upload

    async def run_later(service: Service, task: DatasetTask) -> Any:
        await go_on.wait()
        return await run_upload(service, task)

    monkeypatch.setattr(task_runner, "run_upload", run_later)
    async with connect_service() as (http, service):
        dataset = await new_dataset(http)
        upload = await new_upload(http, dataset, PICTURE, path="images/a.png")
        last = await send(http, upload, 0, PICTURE)
        async with service.pool.connection() as connection:
            await connection.execute("UPDATE uploads SET expires_at = now() - interval '1 hour'")
        await apply_retention(service.pool, Retention(), 1000.0)
        assert (await http.delete(upload)).status_code == 409
        go_on.set()
        task = await task_over(http, httpx.Response(202, headers={"Location": last.headers["Location"]}))
        assert task["state"] == "succeeded"
        assert (await http.get(f"{dataset}/files/images/a.png")).content == PICTURE


CLIENT = """
import json, sys, time
from pathlib import Path
from octasplat.workers.client.api import Api
from octasplat.workers.client.upload import upload_scene

def progress(done, total):
    print(done, flush=True)
    time.sleep(0.03)

with Api(sys.argv[1], sys.argv[2]) as api:
    upload_scene(api, Path(sys.argv[3]), progress=progress)
"""


def large_scene(path: Path) -> int:
    """A ZIP file of 3 photographs that are noise; returns its length."""
    rng = np.random.default_rng(0)
    with zipfile.ZipFile(path, "w") as archive:
        for number in range(3):
            content = io.BytesIO()
            noise = rng.integers(0, 256, (3000, 4000, 3), dtype=np.uint8)
            Image.fromarray(noise).save(content, "PNG", compress_level=0)
            archive.writestr(f"images/{number}.png", content.getvalue())
    return path.stat().st_size


@pytest.mark.exhaustive
def test_upload_goes_on_after_client_and_service_are_killed(conninfo: str, tmp_path: Path) -> None:
    scene = tmp_path / "scene.zip"
    size = large_scene(scene)
    with FrontEnd(conninfo, tmp_path / "data") as front:
        command = [sys.executable, "-c", CLIENT, front.address, front.token, str(scene)]
        client = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert client.stdout is not None
        for line in client.stdout:
            if int(line) > size // 2:
                break
        client.kill()
        client.wait(60)
        client.stdout.close()
        with psycopg.connect(conninfo, autocommit=True) as connection:

            def stored() -> int:
                row = connection.execute("SELECT sum(size_bytes) FROM upload_parts").fetchone()
                return -1 if row is None or row[0] is None else int(row[0])

            # Of the parts that were under way nothing is kept.
            least = size // 2 - PARALLEL_PARTS * receive.PARALLEL_PART_BYTES
            deadline = time.monotonic() + 30
            while stored() < least and time.monotonic() < deadline:
                time.sleep(0.1)
            time.sleep(1.0)  # until the service knows that nothing more comes
            kept = stored()
            assert least <= kept < size
            told: list[int] = []
            killed = threading.Event()

            def progress(done: int, _total: int) -> None:
                told.append(done)
                time.sleep(0.03)
                if not killed.is_set() and done > kept + (size - kept) // 2:
                    killed.set()
                    front.kill()
                    threading.Thread(target=front.start).start()

            with Api(front.address, front.token) as api:
                dataset = upload_scene(api, scene, progress=progress)
            assert killed.is_set()
            assert told[1] >= kept  # after the start at 0 it goes on there
            assert (dataset["state"], dataset["photographs"]) == ("committed", 3)
            assert stored() == -1
            row = connection.execute("SELECT sum(size_bytes) FROM dataset_files").fetchone()
            assert row is not None and size - 1000 < row[0] < size
        repeated = sum(max(0, before - after) for before, after in pairwise(told))
        assert repeated < size // 2
