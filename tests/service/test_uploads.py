"""Uploads through the API: every horror has its problem document, quotas and full disks too."""

import base64
import hashlib
import io
import json
import os
import signal
import socket as socket_module
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import pytest
from PIL import Image

from octasplat.workers.storage.local import LocalStorage
from tests.support.model_builder import ColmapModelBuilder, photograph, photographs
from tests.support.service_harness import BEARER, TOKEN, ConnectService
from tests.support.zip_builder import ZipMember, build_zip

ROOT = Path(__file__).parents[2]


async def new_dataset(http: httpx.AsyncClient) -> str:
    answer = await http.post("/v1/datasets", json={"name": "fox"})
    assert answer.status_code == 201, answer.text
    return answer.headers["Location"]


def repr_digest(data: bytes) -> dict[str, str]:
    return {"Repr-Digest": f"sha-256=:{base64.b64encode(hashlib.sha256(data).digest()).decode()}:"}


def assert_problem(answer: httpx.Response, status: int, code: str) -> dict[str, Any]:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    problem: dict[str, Any] = answer.json()
    assert problem["type"] == f"urn:octasplat:problem:{code}", problem
    assert problem["detail"].endswith(".")
    return problem


async def test_upload_single_files_and_commit(connect_service: ConnectService, tmp_path: Path) -> None:
    async with connect_service() as (http, _):
        dataset = await new_dataset(http)
        files = {**photographs(), **ColmapModelBuilder().files()}
        for name, data in files.items():
            answer = await http.put(f"{dataset}/files/{name}", content=data, headers=repr_digest(data))
            assert answer.status_code == 201, answer.text
        again = await http.put(
            f"{dataset}/files/images/v0.png", content=b"", headers=repr_digest(photograph())
        )
        assert again.status_code == 200
        arrived = (await http.get(f"{dataset}/files")).json()["files"]
        assert {file["path"]: file["sha256"] for file in arrived} == {
            name: hashlib.sha256(data).hexdigest() for name, data in files.items()
        }
        committed = await http.post(f"{dataset}/commit")
        assert committed.status_code == 200 and committed.json()["state"] == "committed", committed.text
        late = await http.put(f"{dataset}/files/images/late.png", content=photograph())
        assert_problem(late, 409, "conflict")
    assert not list((tmp_path / "store" / "staging").iterdir())


async def test_scene_is_previewed_before_it_is_sent(connect_service: ConnectService) -> None:
    """The same answer for the names of a folder and for the end of its archive, and what is refused."""
    names = [*(f"fox/{name}" for name in photographs()), "fox/clip.MOV", "fox/images/a.HEIC"]
    archive = build_zip(*(ZipMember(name, bytes(30_000), method=0) for name in names))
    octets = {"Content-Type": "application/octet-stream"}
    async with connect_service() as (http, _):
        listed = [{"path": name, "size_bytes": 30_000} for name in names]
        folder = (await http.post("/v1/scene-previews", json={"files": listed})).json()
        address = f"/v1/scene-previews/archive?size_bytes={len(archive)}"
        short = (await http.post(address, content=archive[-100:], headers=octets)).json()
        assert 100 < short["needed_bytes"] < len(archive) and not short["files"]
        end = archive[-short["needed_bytes"] :]
        assert (await http.post(address, content=end, headers=octets)).json() == folder
        assert folder["photographs"] == 4 and folder["refusals"] == [] and folder["needed_bytes"] is None
        assert [file["name"] for file in folder["files"]] == [f"images/v{i}.png" for i in range(4)]
        assert [("(images/a.HEIC)" in note, "(clip.MOV)" in note) for note in folder["notes"]] == [
            (True, False), (False, True),
        ]  # fmt: skip
        few = await http.post("/v1/scene-previews", json={"files": listed[2:]})
        assert few.json()["refusals"][0]["code"] == "dataset-photographs"
        damaged = await http.post(
            "/v1/scene-previews/archive?size_bytes=9", content=b"no ZIP ..", headers=octets
        )
        assert damaged.json()["refusals"][0]["code"] == "archive-damaged"
        many = [{"path": f"images/{'long/' * 9}{i:06}.jpg", "size_bytes": 1} for i in range(20_000)]
        assert (await http.post("/v1/scene-previews", json={"files": many})).json()["photographs"] == 20_000


async def test_upload_archive_and_commit(connect_service: ConnectService, tmp_path: Path) -> None:
    files = {**photographs(), **ColmapModelBuilder().files()}
    data = build_zip(
        *(ZipMember(f"fox/{name}", content) for name, content in files.items()), ZipMember("fox/x.md", b"x")
    )

    async with connect_service() as (http, _):
        dataset = await new_dataset(http)
        answer = await http.put(f"{dataset}/archive", content=data, headers=repr_digest(data))
        assert answer.status_code == 200, answer.text
        assert {file["path"] for file in answer.json()["files"]} == set(files)
        assert answer.json()["left_out"] == ["fox/x.md"]
        assert (await http.post(f"{dataset}/commit")).status_code == 200


ARCHIVES = {
    "name-traversal": lambda: build_zip(ZipMember("../evil.jpg", b"x")),
    "name-absolute": lambda: build_zip(ZipMember("/etc/cron.d/evil", b"x")),
    "name-drive": lambda: build_zip(ZipMember("C:/evil.jpg", b"x")),
    "name-twin": lambda: build_zip(
        ZipMember("images/a.png", photograph()), ZipMember("images/A.png", photograph())
    ),
    "archive-link": lambda: build_zip(ZipMember("images/a.png", b"/etc/passwd", mode=0o120777)),
    "archive-ratio": lambda: build_zip(ZipMember("images/a.bmp", bytes(20_000_000))),
    "archive-data-after-end": lambda: build_zip(ZipMember("images/a.png", photograph()), suffix=b"x"),
    "archive-mismatch": lambda: build_zip(
        ZipMember("images/a.png", photograph(), local={"name": b"images/b.png"})
    ),
    "archive-nested": lambda: build_zip(ZipMember("images/a.png", build_zip(), method=0)),
    "archive-kind": lambda: b"\x1f\x8b\x08" + bytes(600),
    "archive-damaged": lambda: b"hello",
    "image-kind": lambda: build_zip(ZipMember("images/a.png", b"<svg>")),
}


@pytest.mark.parametrize("code", ARCHIVES)
async def test_upload_hostile_archive_is_refused(
    connect_service: ConnectService, tmp_path: Path, code: str
) -> None:
    async with connect_service() as (http, _):
        dataset = await new_dataset(http)
        problem = assert_problem(await http.put(f"{dataset}/archive", content=ARCHIVES[code]()), 422, code)
        assert problem["errors"][0]["code"] == code
        assert (await http.get(f"{dataset}/files")).json()["files"] == []
    inside = {path.name for path in tmp_path.rglob("*") if path.is_file()}
    assert not any("evil" in name for name in inside)
    assert not list((tmp_path / "store" / "staging").iterdir())


async def test_hostile_names_and_contents_of_single_files(connect_service: ConnectService) -> None:
    async with connect_service() as (http, _):
        dataset = await new_dataset(http)
        for path, content, status, code in (
            ("images/..%2f..%2fevil.png", photograph(), 422, "name-traversal"),
            ("%2fetc%2fpasswd", photograph(), 422, "name-absolute"),
            ("images/a%00.png", photograph(), 422, "name-nul"),
            ("images/CON.png", photograph(), 422, "name-reserved"),
            ("images/a%5cb.png", photograph(), 422, "name-backslash"),
            ("images/a.exe", photograph(), 422, "name-unexpected"),
            ("state.pkl", b"x", 422, "name-unexpected"),
            ("images/a.png", b"MZ" + bytes(99), 422, "image-kind"),
            ("images/a.png", photograph()[:20], 422, "image-damaged"),
        ):
            answer = await http.put(f"{dataset}/files/{path}", content=content)
            assert_problem(answer, status, code)
            assert (await http.delete(f"{dataset}/files/{path}")).status_code == 404
            assert (await http.get(f"{dataset}/files/{path}")).status_code == 404
        wrong = await http.put(f"{dataset}/files/images/a.png", content=b"x", headers=repr_digest(b"y"))
        assert_problem(wrong, 422, "digest-mismatch")
        headers = {"Repr-Digest": "sha-256=:AAAA:"}
        malformed = await http.put(f"{dataset}/files/images/a.png", content=b"x", headers=headers)
        assert_problem(malformed, 422, "digest-malformed")
        assert (await http.get(f"{dataset}/files")).json()["files"] == []
        cursor = base64.urlsafe_b64encode(b"images/a\0b").decode().rstrip("=")
        assert (await http.get(f"{dataset}/files", params={"cursor": cursor})).status_code == 422
        for name in ("a\0b", "a" * 300, "", "\ud800"):
            answer = await http.post("/v1/datasets", content=json.dumps({"name": name}))
            assert answer.status_code == 422, answer.text


MODELS = {
    "name-traversal": lambda: ColmapModelBuilder().with_image(name="../../../../etc/passwd"),
    "model-pose": lambda: ColmapModelBuilder().with_image(quat_wxyz=(0, 0, 0, 0)),
    "model-camera": lambda: ColmapModelBuilder().with_camera(params=(-1, 31, 16, 12)),
    "model-size": lambda: ColmapModelBuilder().with_camera(width=24, height=32),
    "model-image-missing": lambda: ColmapModelBuilder().with_image(name="v9.png"),
    "model-damaged": lambda: replace(ColmapModelBuilder(), counts={"points3D": 2**40}),
}


async def test_upload_hostile_model_lists_faults_and_can_be_replaced(connect_service: ConnectService) -> None:
    async with connect_service() as (http, _):
        dataset = await new_dataset(http)
        for name, data in photographs().items():
            await http.put(f"{dataset}/files/{name}", content=data)
        for code, make in MODELS.items():
            for name, data in make().files().items():
                await http.put(f"{dataset}/files/{name}", content=data)
            problem = assert_problem(await http.post(f"{dataset}/commit"), 422, code)
            assert problem["errors"][0]["pointer"].startswith("#/files/sparse~10~1")
            assert problem["errors"][0]["file"].startswith("sparse/0/")
            assert (await http.get(dataset)).json()["state"] == "open"
        for name, data in ColmapModelBuilder().files().items():
            await http.put(f"{dataset}/files/{name}", content=data)
        assert (await http.post(f"{dataset}/commit")).status_code == 200


async def test_upload_too_long_is_refused(connect_service: ConnectService) -> None:
    async with connect_service(max_upload_bytes=4000, max_archive_bytes=8000) as (http, _):
        dataset = await new_dataset(http)
        answer = await http.put(f"{dataset}/files/images/a.png", content=bytes(5000))
        assert_problem(answer, 413, "too-large")

        async def without_length() -> AsyncIterator[bytes]:
            for _ in range(100):
                yield bytes(1000)

        answer = await http.put(f"{dataset}/files/images/a.png", content=without_length())
        assert_problem(answer, 413, "too-large")
        assert_problem(await http.put(f"{dataset}/archive", content=bytes(9000)), 413, "too-large")


async def test_upload_beyond_quota_is_refused(connect_service: ConnectService) -> None:
    size = len(photograph())

    async with connect_service(quota_bytes=2 * size + 50, quota_datasets=2) as (http, _):
        dataset = await new_dataset(http)
        first = photograph(32, 24)
        assert (await http.put(f"{dataset}/files/images/a.png", content=first)).status_code == 201
        assert (await http.put(f"{dataset}/files/images/copy.png", content=b"")).status_code == 422
        replaced = await http.put(f"{dataset}/files/images/a.png", content=photograph(24, 32))
        assert replaced.status_code == 201, replaced.text
        for number in range(8, 12):
            answer = await http.put(
                f"{dataset}/files/images/{number}.png", content=photograph(number, number)
            )
            if answer.status_code != 201:
                break
        assert "left of what you may store" in assert_problem(answer, 413, "quota-bytes")["detail"]
        archive = build_zip(
            ZipMember("images/z.png", photograph(40, 40)), ZipMember("images/y.png", photograph(50, 40))
        )
        answer = await http.put(f"{dataset}/archive", content=archive)
        assert answer.status_code == 413 or answer.json()["type"].endswith("archive-too-large"), answer.text
        await new_dataset(http)
        answer = await http.post("/v1/datasets", json={"name": "third"})
        assert_problem(answer, 429, "quota-datasets")
        assert "Retry-After" in answer.headers
        used = sum(file["size_bytes"] for file in (await http.get(f"{dataset}/files")).json()["files"])
        assert used <= 2 * size + 50


async def test_jobs_have_a_quota(connect_service: ConnectService) -> None:
    async with connect_service(quota_jobs=2) as (http, _):
        dataset = await new_dataset(http)
        for name, data in {**photographs(), **ColmapModelBuilder().files()}.items():
            await http.put(f"{dataset}/files/{name}", content=data)
        await http.post(f"{dataset}/commit")
        body = {"kind": "reconstruct", "dataset_id": dataset.rpartition("/")[2]}
        answers = [await http.post("/v1/jobs", json=body) for _ in range(3)]
        assert [answer.status_code for answer in answers] == [202, 202, 429], answers[0].text
        assert_problem(answers[2], 429, "quota-jobs")
        await http.post(f"{answers[0].headers['Location']}/cancel")
        assert (await http.post("/v1/jobs", json=body)).status_code == 202


async def test_upload_truncated_photograph_is_named(connect_service: ConnectService) -> None:
    picture = io.BytesIO()
    Image.effect_noise((160, 120), 80).convert("RGB").save(picture, "JPEG")
    cut = picture.getvalue()[: len(picture.getvalue()) * 3 // 4]
    archive = build_zip(
        *(ZipMember(name, data) for name, data in {**photographs(), "images/v0.jpg": cut}.items())
    )

    async with connect_service() as (http, _):
        dataset = await new_dataset(http)
        for path, content in (("files/images/v0.jpg", cut), ("archive", archive)):
            problem = assert_problem(
                await http.put(f"{dataset}/{path}", content=content), 422, "image-cut-off"
            )
            (fault,) = problem["errors"]
            assert fault["file"] == "images/v0.jpg" and "'images/v0.jpg' is cut off" in fault["detail"]
        assert (await http.get(f"{dataset}/files")).json()["files"] == []
        whole = await http.put(f"{dataset}/files/images/v0.jpg", content=picture.getvalue())
        assert whole.status_code == 201


async def test_upload_on_low_disk_is_refused(connect_service: ConnectService) -> None:
    async with connect_service(floor_bytes=1 << 60) as (http, _):
        dataset = await new_dataset(http)
        for path in ("files/images/a.png", "archive"):
            answer = await http.put(f"{dataset}/{path}", content=photograph())
            assert_problem(answer, 507, "storage-full")
            assert "Retry-After" in answer.headers
            assert str(Path.home()) not in answer.text and "/tmp" not in answer.text


SERVER = """
import sys, uvicorn
from octasplat.service.app import create_app
from octasplat.service.settings import ServiceSettings
uvicorn.run(create_app(ServiceSettings(port=0)), uds=sys.argv[1], log_level="warning")
"""


@pytest.fixture
def start_server(conninfo: str, tmp_path: Path, short_root: Path) -> Iterator[Callable[[], tuple[int, Path]]]:
    """Starts a service in a process of its own; gives its pid and its socket."""
    environment = {
        **os.environ,
        "DATABASE_URL": conninfo,
        "OCTASPLAT_DATA": str(tmp_path),
        "OCTASPLAT_FLOOR_BYTES": "0",
        "OCTASPLAT_TOKEN": TOKEN,
    }
    processes: list[subprocess.Popen[bytes]] = []

    def start() -> tuple[int, Path]:
        socket = short_root / f"{os.getpid()}-{len(processes)}.sock"
        process = subprocess.Popen([sys.executable, "-c", SERVER, str(socket)], env=environment, cwd=ROOT)
        processes.append(process)
        deadline = time.monotonic() + 120
        while not answers(socket):
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.05)
        return process.pid, socket

    yield start
    for process in processes:
        process.terminate()
        process.wait(120)


def answers(path: Path) -> bool:
    """Whether somebody listens."""
    with socket_module.socket(socket_module.AF_UNIX) as probe:
        return probe.connect_ex(str(path)) == 0


def peak_kib(pid: int) -> int:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return int(line.split()[1])
    raise AssertionError(pid)


@pytest.mark.exhaustive
def test_memory_does_not_grow_with_the_upload(
    start_server: Callable[[], tuple[int, Path]], record_property: Callable[[str, object], None]
) -> None:
    pid, socket = start_server()
    megabytes = int(os.environ.get("OCTASPLAT_UPLOAD_MB", "300"))

    def body(count: int) -> Iterator[bytes]:
        for number in range(count):
            yield number.to_bytes(8, "big") * (1 << 17)

    transport = httpx.HTTPTransport(uds=str(socket))
    base = "http://localhost:8642"
    with httpx.Client(transport=transport, base_url=base, headers=BEARER, timeout=600) as http:
        dataset = http.post("/v1/datasets", json={"name": "large"}).headers["Location"]
        name = "sparse/0/points3D.bin"
        assert http.put(f"{dataset}/files/{name}", content=body(8)).status_code == 201
        before = peak_kib(pid)
        began = time.perf_counter()
        answer = http.put(f"{dataset}/files/{name}", content=body(megabytes))
        seconds = time.perf_counter() - began
        assert answer.status_code == 201, answer.text
        assert answer.json()["size_bytes"] == megabytes << 20
    grown = peak_kib(pid) - before
    record_property(
        "upload", f"{megabytes} MiB in {seconds:.1f} s, peak {peak_kib(pid)} KiB, grown {grown} KiB"
    )
    assert grown < 16 << 10


@pytest.mark.exhaustive
def test_upload_to_killed_service_keeps_complete_files_only(
    start_server: Callable[[], tuple[int, Path]], tmp_path: Path
) -> None:
    content = os.urandom(1 << 20) * 24
    digest = repr_digest(content)
    pid, socket = start_server()

    def slow_body() -> Iterator[bytes]:
        for number in range(24):
            if number == 16:
                os.kill(pid, signal.SIGKILL)
            yield content[number << 20 : (number + 1) << 20]

    def connect(path: Path) -> httpx.Client:
        transport = httpx.HTTPTransport(uds=str(path))
        return httpx.Client(transport=transport, base_url="http://localhost:8642", headers=BEARER, timeout=60)

    name = "sparse/0/points3D.bin"
    with connect(socket) as http:
        dataset = http.post("/v1/datasets", json={"name": "killed"}).headers["Location"]
        assert http.put(f"{dataset}/files/images/a.png", content=photograph()).status_code == 201
        with pytest.raises(httpx.TransportError):
            http.put(f"{dataset}/files/{name}", content=slow_body(), headers=digest)
    storage = LocalStorage(tmp_path / "store", floor_bytes=0)
    assert len(list(storage.list_blobs())) == 1
    _, socket = start_server()
    with connect(socket) as http:
        arrived = http.get(f"{dataset}/files").json()["files"]
        assert [file["path"] for file in arrived] == ["images/a.png"]
        answer = http.put(f"{dataset}/files/{name}", content=content, headers=digest)
        assert answer.status_code == 201, answer.text
        assert http.get(f"{dataset}/files/{name}").content == content
    assert storage.remove_stale_uploads(-60) == 1  # what the killed upload left, for the next sweep
    assert len(list(storage.list_blobs())) == 2
    storage.close()
