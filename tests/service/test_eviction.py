"""What is deleted makes room at once where room is short, and nothing goes that somebody is about to name."""

import asyncio
import hashlib
import threading
import time
from pathlib import Path
from typing import BinaryIO

import httpx
import pytest

from octasplat.service.state import Service
from octasplat.workers.maintenance import garbage_collection
from octasplat.workers.maintenance.garbage_collection import collect_garbage_now
from octasplat.workers.queue import storage_leases
from octasplat.workers.storage.errors import StorageUnavailableError
from tests.support.model_builder import photograph
from tests.support.service_harness import running_service
from tests.support.small_disk import small_disk
from tests.support.zip_builder import ZipMember, build_zip

MIB = 1 << 20
PATIENCE_SECONDS = 180.0


def picture(size_bytes: int, name: str) -> bytes:
    """A PNG with so much behind its end."""
    return photograph() + (hashlib.sha256(name.encode()).digest() * (size_bytes // 32))


def held(service: Service) -> set[str]:
    return {entry.blob.sha256 for entry in service.storage.list_blobs()}


async def new_dataset(http: httpx.AsyncClient) -> str:
    return str((await http.post("/v1/datasets", json={"name": "d"})).headers["Location"])


async def until_taken(http: httpx.AsyncClient, address: str, content: bytes) -> None:
    """Send a file as a client does, again while the answer is that there is no room."""
    deadline = time.monotonic() + PATIENCE_SECONDS
    while (answer := await http.put(address, content=content)).status_code == 507:
        assert time.monotonic() < deadline, answer.text
        await asyncio.sleep(0.5)
    assert answer.status_code == 201, answer.text


async def test_deletion_frees_space_for_next_upload(conninfo: str, tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 16) as folder:
        async with running_service(conninfo, tmp_path, storage=str(folder / "store")) as (http, service):
            first, second, third = [await new_dataset(http) for _ in range(3)]
            files = {name: picture(6 * MIB, name) for name in ("a", "b", "c")}
            for dataset, name in ((first, "a"), (second, "b")):
                answer = await http.put(f"{dataset}/files/images/{name}.png", content=files[name])
                assert answer.status_code == 201, answer.text
            answer = await http.put(f"{third}/files/images/c.png", content=files["c"])
            problem = answer.json()
            assert (answer.status_code, problem["type"]) == (507, "urn:octasplat:problem:storage-full")
            assert "delete datasets or jobs, whose contents then go at once" in problem["detail"]
            assert (await http.delete(first)).status_code == 204
            await until_taken(http, f"{third}/files/images/c.png", files["c"])
            assert held(service) == {hashlib.sha256(files[name]).hexdigest() for name in ("b", "c")}


async def test_deletion_frees_space_on_low_disk(conninfo: str, tmp_path: Path) -> None:
    """Nobody uploads anything, and what an archive that broke off has left goes as well."""

    with small_disk(tmp_path / "disk", 16) as folder:
        settings = {"storage": str(folder / "store"), "floor_bytes": 4 * MIB}
        async with running_service(conninfo, tmp_path, **settings) as (http, service):
            dataset = await new_dataset(http)
            for name in ("a", "b"):
                address = f"{dataset}/files/images/{name}.png"
                assert (await http.put(address, content=picture(5 * MIB, name))).status_code == 201
            with service.storage.open_writer() as writer:
                writer.write(b"named by nobody")
                writer.commit()
            await asyncio.sleep(
                garbage_collection._MIN_AGE_SECONDS + garbage_collection.IMMEDIATE_INTERVAL_SECONDS
            )
            assert (await http.delete(f"{dataset}/files/images/a.png")).status_code == 204
            deadline = time.monotonic() + PATIENCE_SECONDS
            while len(held(service)) > 1:
                assert time.monotonic() < deadline
                await asyncio.sleep(0.1)
            assert (await http.get(f"{dataset}/files/images/b.png")).content == picture(5 * MIB, "b")


@pytest.fixture
def sharp(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the margins that would hide a race; the clocks here are one."""
    monkeypatch.setattr(garbage_collection, "_MIN_AGE_SECONDS", 0.0)
    monkeypatch.setattr(
        garbage_collection, "MAX_CLOCK_SKEW_SECONDS", 0.05
    )  # file times have the resolution of a tick


@pytest.mark.exhaustive
async def test_garbage_collection_spares_contents_of_running_uploads(
    conninfo: str, tmp_path: Path, sharp: None
) -> None:
    """Archives with the same contents, again and again, while others delete them and all is collected."""
    contents = {f"images/{n}.png": picture(2000, str(n)) for n in range(12)}
    archive = build_zip(*(ZipMember(name, content) for name, content in contents.items()))

    async def upload(http: httpx.AsyncClient, over: asyncio.Event) -> int:
        count = 0
        while not over.is_set():
            dataset = await new_dataset(http)
            assert (await http.put(f"{dataset}/archive", content=archive)).status_code == 200
            for name in list(contents)[:2]:
                answer = await http.get(f"{dataset}/files/{name}")
                assert answer.status_code == 200 and answer.content == contents[name], answer.text
            assert (await http.delete(dataset)).status_code == 204
            count += 1
        return count

    async with running_service(conninfo, tmp_path) as (http, service):
        over = asyncio.Event()
        uploads = [asyncio.create_task(upload(http, over)) for _ in range(3)]
        removed = 0
        deadline = time.monotonic() + PATIENCE_SECONDS
        while removed < 20 and time.monotonic() < deadline:
            found = await collect_garbage_now(service.pool, service.storage, every_seconds=0.0)
            removed += found.blobs if found is not None else 0
            if any(task.done() for task in uploads):
                break
        over.set()
        assert min(await asyncio.gather(*uploads)) > 0 and removed >= 20
        await collect_garbage_now(service.pool, service.storage, every_seconds=0.0)
        async with service.pool.connection() as connection:
            assert await storage_leases.oldest_lease(connection) is None


async def test_storage_lease_protects_contents_until_expired(
    conninfo: str, tmp_path: Path, sharp: None
) -> None:
    def store(service: Service, content: bytes) -> str:
        with service.storage.open_writer() as writer:
            writer.write(content)
            return writer.commit().sha256

    async with running_service(conninfo, tmp_path) as (_, service):
        pool, storage = service.pool, service.storage
        old = store(service, b"stored before and named by nobody")
        await asyncio.sleep(0.2)
        async with storage_leases.storage_lease(pool, storage):
            young = store(service, b"about to be named")
            removed = await collect_garbage_now(pool, storage, every_seconds=0.0)
            assert removed is not None and held(service) == {young} and old not in held(service)
        async with storage_leases.storage_lease(pool, storage) as note:
            store(service, b"about to be named")
            async with pool.connection() as connection:
                await connection.execute("UPDATE storing SET seen_at = now() - interval '1 hour'")
            # A note that is being confirmed is not given up, however old.
            async with note.reference([young]):
                await collect_garbage_now(pool, storage, every_seconds=0.0)
                assert held(service) == {young}
            await collect_garbage_now(pool, storage, every_seconds=0.0)
            assert not held(service)
            with pytest.raises(StorageUnavailableError, match="silent for too long"):
                async with note.reference([young]):
                    pass


@pytest.mark.parametrize("ends", ["before the content is checked", "after the content is checked"])
async def test_content_stored_during_removal_is_kept(
    conninfo: str, tmp_path: Path, sharp: None, s3_address: str, s3_bucket: str, ends: str
) -> None:
    """A bucket removes what was looked at a moment before; whoever stores it in that moment hears of it."""
    content = picture(2000, "a")

    address = f"s3://{s3_bucket}/x?endpoint_url={s3_address}"
    async with running_service(conninfo, tmp_path, storage=address) as (http, service):
        with service.storage.open_writer() as writer:
            writer.write(content)
            writer.commit()
        await asyncio.sleep(1.1)  # the times of a bucket are whole seconds
        loop, looked, go_on = asyncio.get_running_loop(), asyncio.Event(), threading.Event()
        at_check = asyncio.Event()
        client = service.storage.client  # type: ignore[attr-defined]
        delete = client.delete_object

        def slowly(**given: object) -> object:
            loop.call_soon_threadsafe(looked.set)
            assert go_on.wait(PATIENCE_SECONDS)
            return delete(**given)

        client.delete_object = slowly
        stored, check, opened = service.storage, threading.Event(), service.storage.open

        def open_late(sha256: str) -> BinaryIO:
            loop.call_soon_threadsafe(at_check.set)
            assert check.wait(PATIENCE_SECONDS)
            return opened(sha256)

        stored.open = open_late  # type: ignore[method-assign]
        removing = asyncio.create_task(collect_garbage_now(service.pool, service.storage, every_seconds=0.0))
        await looked.wait()
        address = f"{await new_dataset(http)}/files/images/a.png"
        put = asyncio.create_task(http.put(address, content=content))
        await at_check.wait()
        if ends == "after the content is checked":
            check.set()
            await asyncio.sleep(0.3)
        go_on.set()
        assert (removed := await removing) is not None and removed.blobs == 1
        check.set()
        answer = await put
        while answer.status_code == 503:
            assert "Retry-After" in answer.headers
            answer = await http.put(address, content=content)
        assert answer.status_code == 201, answer.text
        assert (await http.get(address)).content == content
