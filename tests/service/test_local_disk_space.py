"""Archives take no more room here than allowed, wherever the store is; a store that is away shows."""

import asyncio
import os
from collections.abc import AsyncIterator
from pathlib import Path

import httpx

from tests.support.model_builder import photograph
from tests.support.service_harness import running_service
from tests.support.small_disk import fill, small_disk
from tests.support.zip_builder import ZipMember, build_zip

MIB = 1 << 20


async def new_dataset(http: httpx.AsyncClient) -> str:
    return str((await http.post("/v1/datasets", json={"name": "d"})).headers["Location"])


async def test_archive_spool_space_is_limited(conninfo: str, tmp_path: Path) -> None:
    archive = build_zip(*(ZipMember(f"images/{n}.png", photograph() + os.urandom(MIB)) for n in range(3)))

    with small_disk(tmp_path / "disk", 16) as disk:
        settings = {"work": disk, "max_spool_bytes": 5 * MIB, "storage": str(tmp_path / "elsewhere")}
        async with running_service(conninfo, tmp_path, **settings) as (http, _):
            answer = await http.put(f"{await new_dataset(http)}/archive", content=archive)
            assert answer.status_code == 507 and "Your archives" in answer.json()["detail"], answer.text
        settings["spool_share"] = 1.0
        async with running_service(conninfo, tmp_path, **settings) as (http, _):
            first, second = await new_dataset(http), await new_dataset(http)
            begun, go_on = asyncio.Event(), asyncio.Event()

            async def slowly() -> AsyncIterator[bytes]:
                yield archive[:-1000]
                begun.set()  # what came so far is counted
                await go_on.wait()
                yield archive[-1000:]

            headers = {"Content-Length": str(len(archive))}
            slow = asyncio.create_task(http.put(f"{first}/archive", content=slowly(), headers=headers))
            await begun.wait()
            try:
                answer = await http.put(f"{second}/archive", content=archive)
            finally:
                go_on.set()
            assert answer.status_code == 507, answer.text
            assert "archives that are being read" in answer.json()["detail"]
            assert (await slow).status_code == 200
            assert (await http.put(f"{second}/archive", content=archive)).status_code == 200
        settings["floor_bytes"] = 4 * MIB
        fill(disk, 5 * MIB)
        async with running_service(conninfo, tmp_path, **settings) as (http, _):
            answer = await http.put(f"{await new_dataset(http)}/archive", content=archive)
            assert answer.status_code == 507 and "disk for archives" in answer.json()["detail"], answer.text


async def test_unreachable_store_is_not_ready(conninfo: str, tmp_path: Path) -> None:
    async with running_service(conninfo, tmp_path) as (http, _):
        assert (await http.get("/readyz")).json()["checks"]["storage"] == "ok"
        store = tmp_path / "store"
        store.rename(tmp_path / "away")
        answer = await http.get("/readyz")
        assert (answer.status_code, answer.json()["checks"]["storage"]) == (503, "unreachable")
        store.mkdir()  # as where a disk was mounted
        assert (await http.get("/readyz")).json()["checks"]["storage"] == "unreachable"
        store.rmdir()
        (tmp_path / "away").rename(store)
        assert (await http.get("/readyz")).status_code == 200


async def test_unreachable_bucket_is_not_ready(
    conninfo: str, tmp_path: Path, s3_address: str, s3_bucket: str
) -> None:
    for address in (
        f"s3://nowhere/x?endpoint_url={s3_address}",
        "s3://b/x?endpoint_url=http://127.0.0.1:9",
    ):
        async with running_service(conninfo, tmp_path, storage=address) as (http, _):
            answer = await http.get("/readyz")
            assert (answer.status_code, answer.json()["checks"]["storage"]) == (503, "unreachable")
    address = f"s3://{s3_bucket}/x?endpoint_url={s3_address}"
    async with running_service(conninfo, tmp_path, storage=address) as (http, _):
        assert (await http.get("/readyz")).status_code == 200
