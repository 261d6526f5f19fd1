"""A dataset that differs in a few files from one that is there: only these files are sent."""

import asyncio
import hashlib
import io
import re
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

import octasplat as osp
from octasplat.engine.core.events import Event, Noted
from octasplat.service.actions import reused_files
from octasplat.service.state import Service
from octasplat.workers.cli.main import cli
from octasplat.workers.client import dataset_files, upload
from octasplat.workers.client.api import Api, ServiceError
from octasplat.workers.client.upload import upload_files, upload_scene
from octasplat.workers.db.quotas import Quota, set_quota
from octasplat.workers.maintenance import garbage_collection
from octasplat.workers.maintenance.garbage_collection import collect_garbage_now
from tests.support.front_end import FrontEnd
from tests.support.model_builder import ColmapModelBuilder, photograph, photographs
from tests.support.service_harness import BEARER, ConnectService, client_with_token
from tests.support.zip_builder import ZipMember, build_zip

SCENE = {**photographs(), **ColmapModelBuilder().files()}
NAME, PICTURE = next(iter(photographs().items()))


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def wanted(files: Mapping[str, bytes]) -> dict[str, Any]:
    return {"files": [{"path": name, "sha256": sha256(content)} for name, content in files.items()]}


async def new_dataset(http: httpx.AsyncClient, headers: dict[str, str] = BEARER, **body: str) -> str:
    answer = await http.post("/v1/datasets", json={"name": "d", **body}, headers=headers)
    return str(answer.headers["Location"])


async def filled_dataset(
    http: httpx.AsyncClient, files: Mapping[str, bytes], headers: dict[str, str] = BEARER, **body: str
) -> str:
    dataset = await new_dataset(http, headers, **body)
    for name, content in files.items():
        answer = await http.put(f"{dataset}/files/{name}", content=content, headers=headers)
        assert answer.status_code == 201, answer.text
    return dataset


async def reuse(
    http: httpx.AsyncClient, dataset: str, files: Mapping[str, bytes], headers: dict[str, str] = BEARER
) -> tuple[list[str], list[str]]:
    answer = await http.post(f"{dataset}/files", json=wanted(files), headers=headers)
    assert answer.status_code == 200, answer.text
    return [file["path"] for file in answer.json()["files"]], answer.json()["missing"]


async def collect(service: Service) -> None:
    await collect_garbage_now(service.pool, service.storage, every_seconds=0)


@pytest.fixture
def no_grace(monkeypatch: pytest.MonkeyPatch) -> None:
    """Contents are collected however young they are."""
    for name in ("_MIN_AGE_SECONDS", "MAX_CLOCK_SKEW_SECONDS"):
        monkeypatch.setattr(garbage_collection, name, 0.0)


async def test_files_of_another_dataset_are_taken_and_committed(connect_service: ConnectService) -> None:
    changed = {**SCENE, NAME: photograph(24, 32)}
    async with connect_service() as (http, _):
        first = await filled_dataset(http, SCENE)
        second = await new_dataset(http)
        taken, missing = await reuse(http, second, SCENE)
        assert (taken, missing) == (sorted(SCENE), [])
        listed = [(await http.get(f"{dataset}/files")).json()["files"] for dataset in (first, second)]
        for file in [*listed[0], *listed[1]]:
            file.pop("uploaded_at")
        assert listed[0] == listed[1]  # with what is known of each image
        committed = await http.post(f"{second}/commit")
        assert committed.status_code == 200 and committed.json()["has_poses"], committed.text
        usage = (await http.get("/v1/usage")).json()["bytes"]["used"]
        assert usage == sum({sha256(c): len(c) for c in SCENE.values()}.values())
        # The check of the model at commit is that of what was sent.
        third = await new_dataset(http)
        assert await reuse(http, third, changed) == (sorted(changed.keys() - {NAME}), [NAME])
        assert (await http.put(f"{third}/files/{NAME}", content=changed[NAME])).status_code == 201
        refused = await http.post(f"{third}/commit")
        assert refused.status_code == 422 and refused.json()["type"].endswith("model-size"), refused.text


async def test_what_another_owner_has_is_not_told(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        await filled_dataset(http, SCENE)
        bob, boss = [await client_with_token(service, *who) for who in (("bob", "write"), ("boss", "admin"))]
        theirs = await new_dataset(http, bob)
        for headers in (bob, boss):  # an administrator sends for the owner of the dataset
            answers = [
                await http.post(f"{theirs}/files", json=wanted({NAME: content}), headers=headers)
                for content in (PICTURE, b"what nobody has")
            ]
            assert [answer.json() for answer in answers] == 2 * [{"files": [], "missing": [NAME]}]
        assert (await http.get(f"{theirs}/files", headers=bob)).json()["files"] == []
        mine = await new_dataset(http)
        assert (await http.post(f"{mine}/files", json=wanted(SCENE), headers=bob)).status_code == 404


async def test_file_stays_when_the_dataset_that_it_came_from_is_evicted(
    connect_service: ConnectService, no_grace: None
) -> None:
    async with connect_service() as (http, service):
        first = await filled_dataset(http, SCENE)
        second = await new_dataset(http)
        few = dict(list(SCENE.items())[:-1])
        await reuse(http, second, few)
        assert (await http.delete(first)).status_code == 204
        await asyncio.sleep(0.05)
        await collect(service)
        assert len(list(service.storage.list_blobs())) == len({sha256(c) for c in few.values()})
        for name, content in few.items():
            assert (await http.get(f"{second}/files/{name}")).content == content


async def test_file_that_is_evicted_while_it_is_looked_at_is_sent(
    connect_service: ConnectService, no_grace: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    look_at = reused_files._look_at
    async with connect_service() as (http, service):
        first = await filled_dataset(http, {NAME: PICTURE})
        second = await new_dataset(http)
        await asyncio.sleep(0.05)

        async def look_at_and_evict(*given: Any) -> Any:
            found = await look_at(*given)
            if (await http.delete(first)).status_code == 204:
                await collect(service)
                assert [file.path for file in found] == [NAME] and not list(service.storage.list_blobs())
            return found

        monkeypatch.setattr(reused_files, "_look_at", look_at_and_evict)
        assert await reuse(http, second, {NAME: PICTURE}) == ([], [NAME])
        assert (await http.put(f"{second}/files/{NAME}", content=PICTURE)).status_code == 201
        assert (await http.get(f"{second}/files/{NAME}")).content == PICTURE


@pytest.mark.exhaustive
async def test_eviction_at_the_same_time_leaves_no_file_without_content(
    connect_service: ConnectService, no_grace: None
) -> None:
    async with connect_service() as (http, service):
        outcomes = set[bool]()

        async def evict(dataset: str, seconds: float) -> None:
            await asyncio.sleep(seconds)
            assert (await http.delete(dataset)).status_code == 204
            await collect(service)

        for number in range(24):
            first, second = await filled_dataset(http, {NAME: PICTURE}), await new_dataset(http)
            (taken, _), _ = await asyncio.gather(
                reuse(http, second, {NAME: PICTURE}), evict(first, 0.002 * (number % 12))
            )
            await collect(service)
            read = await http.get(f"{second}/files/{NAME}")
            assert (read.status_code, read.content == PICTURE) == ((200, True) if taken else (404, False))
            outcomes.add(bool(taken))
            await http.delete(second)
            await collect(service)
        assert True in outcomes


async def test_content_that_the_store_has_lost_or_damaged_is_sent(
    connect_service: ConnectService, tmp_path: Path
) -> None:
    async with connect_service() as (http, service):
        pictures = {f"images/{width}.png": photograph(width) for width in range(30, 34)}
        await filled_dataset(http, pictures)
        contents = {name: sha256(content) for name, content in pictures.items()}
        lost, cut, *_ = contents
        service.storage.delete(contents[lost])
        path = tmp_path / "store" / "blobs" / contents[cut][:2] / contents[cut]
        path.unlink()
        path.write_bytes(pictures[cut][:-1])
        second = await new_dataset(http)
        taken, missing = await reuse(http, second, pictures)
        assert (set(taken), missing) == (contents.keys() - {lost, cut}, [lost, cut])


async def test_files_are_taken_within_a_bucket(
    connect_service: ConnectService, s3_address: str, s3_bucket: str
) -> None:
    storage = f"s3://{s3_bucket}/store?endpoint_url={s3_address}"
    pictures = {f"images/{width}.png": photograph(width) for width in range(30, 34)}
    lost, *kept = pictures
    async with connect_service(storage=storage) as (http, service):
        await filled_dataset(http, pictures)
        await asyncio.to_thread(service.storage.delete, sha256(pictures[lost]))
        second = await new_dataset(http)
        assert await reuse(http, second, pictures) == (kept, [lost])
        assert (await http.put(f"{second}/files/{lost}", content=pictures[lost])).status_code == 201
        assert (await http.post(f"{second}/commit")).json()["photographs"] == 4


async def test_contents_and_names_are_checked_as_if_they_were_sent(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        await filled_dataset(http, {"notes.txt": b"no picture"}, holds="files")
        dataset = await filled_dataset(http, {NAME: PICTURE})
        for files, code in (
            ({"images/a.png": b"no picture"}, "image-kind"),
            ({"images/../../a.png": PICTURE}, "name-traversal"),
            ({"a.exe": PICTURE}, "name-unexpected"),
        ):
            refused = await http.post(f"{dataset}/files", json=wanted(files))
            problem = refused.json()
            assert (refused.status_code, problem["type"]) == (422, f"urn:octasplat:problem:{code}"), problem
            assert refused.headers["content-type"] == "application/problem+json"
            assert problem["errors"][0]["file"] in files and problem["detail"].count(". ") == 0
        twice = {"files": 2 * wanted({NAME: PICTURE})["files"]}
        short = {"files": [{"path": NAME, "sha256": "abc"}]}
        many = {"files": 1001 * wanted({NAME: PICTURE})["files"]}
        for body in (twice, short, many, {"files": [{"path": "", "sha256": sha256(PICTURE)}]}, {}):
            assert (await http.post(f"{dataset}/files", json=body)).status_code == 422
        assert [file["path"] for file in (await http.get(f"{dataset}/files")).json()["files"]] == [NAME]
        async with service.pool.connection() as connection:
            await connection.execute("UPDATE datasets SET state = 'committed'")
        closed = await http.post(f"{dataset}/files", json=wanted({NAME: PICTURE}))
        assert closed.status_code == 409


async def test_limits_of_uploads_hold(connect_service: ConnectService) -> None:
    async with connect_service(max_upload_bytes=len(PICTURE)) as (http, service):
        me = await client_with_token(service, "me", "write")
        await filled_dataset(http, {NAME: PICTURE}, me)
        second = await new_dataset(http, me)
        async with service.pool.connection() as connection:
            await set_quota(connection, "me", Quota(max_bytes=len(PICTURE)))
        assert await reuse(http, second, {NAME: PICTURE}, me) == ([NAME], [])
        async with service.pool.connection() as connection:
            await set_quota(connection, "me", Quota(max_bytes=len(PICTURE) - 1))
        third = await new_dataset(http, me)
        refused = await http.post(f"{third}/files", json=wanted({NAME: PICTURE}), headers=me)
        assert (refused.status_code, refused.json()["type"]) == (413, "urn:octasplat:problem:quota-bytes")
        assert (await http.get(f"{third}/files", headers=me)).json()["files"] == []
    async with connect_service(max_upload_bytes=len(PICTURE) - 1, has_token=False) as (http, _):
        refused = await http.post(f"{third}/files", json=wanted({NAME: PICTURE}), headers=me)
        assert (refused.status_code, refused.json()["type"]) == (413, "urn:octasplat:problem:too-large")


def noise_scene(folder: Path, count: int, side: int) -> int:
    """Photographs that are noise, each another one; returns their length in all."""
    rng = np.random.default_rng(0)
    (folder / "images").mkdir(parents=True)
    total = 0
    for number in range(count):
        content = io.BytesIO()
        noise = rng.integers(0, 256, (side, side, 3), dtype=np.uint8)
        Image.fromarray(noise).save(content, "PNG", compress_level=0)
        total += (folder / "images" / f"{number:02}.png").write_bytes(content.getvalue())
    return total


def uploaded_bytes(front: FrontEnd) -> int:
    """What has been sent to a front end since it was started, as files."""
    text = httpx.get(f"{front.address}/metrics", headers={"Authorization": f"Bearer {front.token}"}).text
    found = re.search(r"^octasplat_upload_bytes_total (\S+)$", text, re.MULTILINE)
    assert found is not None
    return int(float(found[1]))


def test_changed_folder_sends_only_what_changed(
    conninfo: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the command and in Python, which both tell how much was not sent."""
    monkeypatch.setattr(dataset_files, "MAX_ASKED_FILES", 5)
    scene = tmp_path / "scene"
    total = noise_scene(scene, 12, 50)
    with FrontEnd(conninfo, tmp_path / "data") as front:
        monkeypatch.setenv("OCTASPLAT_SERVER", front.address)
        monkeypatch.setenv("OCTASPLAT_TOKEN", front.token)
        first = CliRunner().invoke(cli, ["submit", str(scene)])
        assert first.exit_code == 0 and "not sent" not in first.stderr, first.output
        assert uploaded_bytes(front) == total
        changed = scene / "images" / "03.png"
        Image.new("RGB", (50, 50), "red").save(changed)
        (scene / "images" / "11.png").rename(scene / "images" / "12.png")
        told = CliRunner().invoke(cli, ["submit", str(scene)])
        assert told.exit_code == 0, told.output
        assert uploaded_bytes(front) == total + changed.stat().st_size
        kept = f"{(total - total // 12) / 1e3:.1f} kB"
        assert f"11 of the 12 files ({kept}) were not sent, as the service has them already." in told.stderr
        assert first.stdout != told.stdout
        heard: list[Event] = []
        with osp.Client() as client:
            client.submit(scene, progress=heard.append)
            (scene / "images" / "12.png").unlink()
            client.submit(scene, progress=heard.append)
        sizes = [total - count * (total // 12) + changed.stat().st_size for count in (1, 2)]
        assert [event.message for event in heard if isinstance(event, Noted)] == [
            f"None of the {count} files ({size / 1e3:.1f} kB) was sent, as the service has them already."
            for count, size in zip((12, 11), sizes, strict=True)
        ]
        assert uploaded_bytes(front) == total + changed.stat().st_size
        mesh = tmp_path / "a.obj"
        mesh.write_text("v 0 0 0\n")
        notes: list[str] = []
        with Api(front.address, front.token) as api:
            for name in ("a.obj", "b.obj"):
                upload_files(api, {name: mesh}, on_note=notes.append)
        assert notes == ["b.obj (8 bytes) was not sent, as the service has it already."]


@pytest.mark.exhaustive
def test_file_that_changes_after_it_was_read_is_refused(
    conninfo: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    noise_scene(tmp_path / "scene", 3, 8)
    changing = tmp_path / "scene" / "images" / "01.png"

    def read_before_change(path: Path) -> str:
        digest = sha256(path.read_bytes())
        if path == changing:
            Image.new("RGB", (8, 8), "red").save(path)
        return digest

    with FrontEnd(conninfo, tmp_path / "data") as front, Api(front.address, front.token) as api:
        with monkeypatch.context() as patch, pytest.raises(ServiceError, match=r"SHA-256[^.]*\.$") as refused:
            patch.setattr(dataset_files, "sha256_of", read_before_change)
            upload_scene(api, tmp_path / "scene")
        assert refused.value.status == 422
        assert upload_scene(api, tmp_path / "scene")["state"] == "committed"


def test_scene_that_another_client_sends_and_commits_meanwhile_is_taken(
    conninfo: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As by the same command twice at once: a folder, a ZIP file in one request, and one in parts."""
    folder, archive = tmp_path / "scene", tmp_path / "scene.zip"
    noise_scene(folder, 3, 50)
    archive.write_bytes(build_zip(*(ZipMember(name, content) for name, content in SCENE.items())))
    with FrontEnd(conninfo, tmp_path / "data") as front, Api(front.address, front.token) as api:
        for scene, min_resumable_bytes in ((folder, 1 << 30), (archive, 1 << 30), (archive, 1)):
            others: list[Any] = []

            def read_after_another(path: Path, scene: Path = scene, others: list[Any] = others) -> str:
                if not others:
                    others.append(None)
                    others.append(upload_scene(api, scene)["id"])
                return sha256(path.read_bytes())

            with monkeypatch.context() as patch:
                patch.setattr(upload, "MIN_RESUMABLE_BYTES", min_resumable_bytes)
                for module in (dataset_files, upload):
                    patch.setattr(module, "sha256_of", read_after_another)
                dataset = upload_scene(api, scene)
            assert (dataset["state"], dataset["id"]) == ("committed", others[1])
            api.request("DELETE", f"/v1/datasets/{dataset['id']}")


CLIENT = """
import sys, time
from pathlib import Path
from octasplat.workers.client.api import Api
from octasplat.workers.client.upload import upload_scene

def progress(done, total):
    print(done, flush=True)
    time.sleep(0.1)

with Api(sys.argv[1], sys.argv[2]) as api:
    upload_scene(api, Path(sys.argv[3]), progress=progress)
"""


@pytest.mark.exhaustive
def test_folder_goes_on_after_its_client_is_killed(conninfo: str, tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    total = noise_scene(scene, 24, 60)
    size = total // 24
    with FrontEnd(conninfo, tmp_path / "data") as front:
        command = [sys.executable, "-c", CLIENT, front.address, front.token, str(scene)]
        client = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert client.stdout is not None
        for line in client.stdout:
            if int(line) > total // 2:
                break
        client.kill()
        client.wait(60)
        client.stdout.close()
        time.sleep(1.0)  # what was on its way arrives, or does not
        before = uploaded_bytes(front)
        assert total // 2 < before < total
        notes: list[str] = []
        with Api(front.address, front.token) as api:
            assert upload_scene(api, scene, on_note=notes.append)["photographs"] == 24
        assert uploaded_bytes(front) == total
        assert notes[0].startswith(f"{before // size} of the 24 files")
