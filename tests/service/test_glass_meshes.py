"""Stages with a mesh that is to be glass and is not closed are refused before the job is queued."""

import asyncio
import threading
import uuid
from pathlib import Path
from typing import Any

import httpx
import pytest
from test_stage_jobs import finished, sent

from octasplat.service.actions import glass_meshes
from octasplat.service.intake import mesh_check
from octasplat.service.intake.mesh_check import MeshLimits
from octasplat.service.settings import ServiceSettings
from octasplat.service.state import Service
from tests.support.service_harness import ConnectService, claim_job, client_with_token, running_service

TETRAHEDRON = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
LEAF = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
WITH_MATERIAL = b"mtllib a.mtl\nusemtl a\n" + TETRAHEDRON
MTL = b"newmtl a\nmap_Kd bark.ppm.png\n"
GLASS = "[[meshes]]\nshape = 'cube'\n[[meshes]]\nfile = '{}'\nmaterial = {{ kind = 'glass' }}\n"
OPEN = (
    "meshes[1]: {} is not closed (3 edges without two faces that wind alike), so that it cannot be glass; "
    "close it or choose another material."
)


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a busy machine take its time for the check."""
    monkeypatch.setattr(glass_meshes, "WAIT_SECONDS", 600)
    monkeypatch.setattr(ServiceSettings, "mesh_limits", lambda _settings: MeshLimits(seconds=300))


async def render_of(http: httpx.AsyncClient, service: Service, files: dict[str, bytes]) -> dict[str, Any]:
    """The body of a render with these files, without its stage."""
    source = await finished(http, service, {"scene.ply": b"ply"})
    return {"kind": "render", "source_id": source, "files_id": await sent(http, files)}


def staged(body: dict[str, Any], *files: str, material: str = "glass") -> dict[str, Any]:
    stage = "".join(GLASS.format(file) for file in files).replace("glass", material)
    return {**body, "options": {"frames": 2, "stage": stage}}


async def test_open_glass_is_refused_before_it_is_queued(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        files = {"things/leaf.obj": LEAF, "whole.obj": TETRAHEDRON, "none.obj": b"v 0 0 0\n"}
        body = await render_of(http, service, files)
        refused = await http.post("/v1/jobs", json=staged(body, "things/leaf.obj", "whole.obj", "none.obj"))
        problem = refused.json()
        assert (refused.status_code, problem["type"]) == (422, "urn:octasplat:problem:stage-mesh"), problem
        assert refused.headers["content-type"] == "application/problem+json"
        assert problem["detail"] == OPEN.format("things/leaf.obj")
        first, second = problem["errors"]
        assert first == {
            "pointer": "#/options/stage/meshes/1/file",
            "detail": problem["detail"],
            "file": "things/leaf.obj",
        }
        assert second["pointer"] == "#/options/stage/meshes/5/file" and "no triangles" in second["detail"]
        assert (await http.get("/v1/jobs", params={"kind": "render"})).json()["jobs"] == []
        for asked in (staged(body, "whole.obj"), staged(body, "things/leaf.obj", material="mirror")):
            made = await http.post("/v1/jobs", json=asked)
            assert made.status_code == 202, made.text


async def test_images_of_glass_are_only_looked_for(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        files = {"a.obj": WITH_MATERIAL, "a.mtl": MTL.replace(b"bark.ppm", b"tree/bark")}
        lacking = await http.post("/v1/jobs", json=staged(await render_of(http, service, files), "a.obj"))
        assert lacking.status_code == 422
        assert lacking.json()["detail"].startswith("a.mtl: names the image tree/bark.png, which is not in")
        picture = (Path(__file__).parents[2] / "docs/images/light/plush.jpg").read_bytes()
        files = {"a.obj": WITH_MATERIAL, "a.mtl": MTL.replace(b"ppm.png", b"jpg"), "bark.jpg": picture}
        made = await http.post("/v1/jobs", json=staged(await render_of(http, service, files), "a.obj"))
        assert made.status_code == 202, made.text


async def test_meshes_in_a_bucket_are_checked(
    conninfo: str, tmp_path: Path, s3_address: str, s3_bucket: str
) -> None:
    storage = f"s3://{s3_bucket}/x?endpoint_url={s3_address}"
    async with running_service(conninfo, tmp_path, storage=storage) as (http, service):
        body = await render_of(http, service, {"leaf.obj": LEAF})
        refused = await http.post("/v1/jobs", json=staged(body, "leaf.obj"))
        assert refused.status_code == 422 and refused.json()["detail"] == OPEN.format("leaf.obj")


@pytest.mark.parametrize(
    "limits",
    [{"max_bytes": len(LEAF) - 1}, {"cpu_seconds": 0}, {"seconds": 0.1}, {"memory_bytes": 100 << 20}],
)
async def test_check_beyond_its_limits_is_left_to_the_job(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch, limits: dict[str, Any]
) -> None:
    monkeypatch.setattr(ServiceSettings, "mesh_limits", lambda _settings: MeshLimits(**limits))
    async with connect_service() as (http, service):
        body = await render_of(http, service, {"leaf.obj": LEAF})
        made = await http.post("/v1/jobs", json=staged(body, "leaf.obj"))
        assert made.status_code == 202, made.text


async def test_others_are_answered_while_meshes_are_checked(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch
) -> None:
    is_begun, may_end = threading.Event(), threading.Event()
    run_parser = mesh_check.run_parser

    def run_late(*given: Any) -> Any:
        is_begun.set()
        assert may_end.wait(300)
        return run_parser(*given)

    monkeypatch.setattr(mesh_check, "run_parser", run_late)
    async with connect_service() as (http, service):
        body = await render_of(http, service, {"leaf.obj": LEAF})
        asked = asyncio.create_task(http.post("/v1/jobs", json=staged(body, "leaf.obj")))
        assert await asyncio.to_thread(is_begun.wait, 300)
        # Of the same owner, whose lock the check does not hold.
        other = await http.post("/v1/jobs", json={**body, "options": {"stage": "[[meshes]]\nshape = 'cube'"}})
        assert other.status_code == 202 and not asked.done()
        may_end.set()
        assert (await asked).status_code == 422


async def test_checks_of_one_owner_follow_each_other(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch
) -> None:
    is_begun, may_end = threading.Event(), threading.Event()
    run_parser = mesh_check.run_parser

    def run_late(*given: Any) -> Any:
        if not is_begun.is_set():  # the first one
            is_begun.set()
            assert may_end.wait(300)
        return run_parser(*given)

    monkeypatch.setattr(mesh_check, "run_parser", run_late)
    async with connect_service() as (http, service):
        body = staged(await render_of(http, service, {"leaf.obj": LEAF}), "leaf.obj")
        asked = [asyncio.create_task(http.post("/v1/jobs", json=body)) for _ in range(3)]
        assert await asyncio.to_thread(is_begun.wait, 300)
        other = await client_with_token(service, "eve", "admin")
        refused = await http.post("/v1/jobs", json=body, headers=other)
        assert refused.status_code == 422 and not any(task.done() for task in asked)
        may_end.set()
        assert {(await task).status_code for task in asked} == {422}


async def test_retries_with_open_glass_are_refused(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with connect_service() as (http, service):
        body = await render_of(http, service, {"leaf.obj": LEAF})
        key = {"Idempotency-Key": "once"}
        with monkeypatch.context() as patch:
            patch.setattr(ServiceSettings, "mesh_limits", lambda _settings: MeshLimits(max_bytes=0))
            made = await http.post("/v1/jobs", json=staged(body, "leaf.obj"), headers=key)
        # The same answer as before, as nothing new is asked for.
        again = await http.post("/v1/jobs", json=staged(body, "leaf.obj"), headers=key)
        assert (again.status_code, again.json()["id"]) == (202, made.json()["id"])
        address = f"/v1/jobs/{made.json()['id']}/retry"
        running = await http.post(address)
        assert running.status_code == 409
        await (await claim_job(service, made.json())).fail({"type": "config_error", "message": "x."})
        refused = await http.post(address)
        assert refused.status_code == 422 and refused.json()["detail"] == OPEN.format("leaf.obj")
        matt = staged(body, "leaf.obj", material="diffuse")["options"]
        retried = await http.post(address, json={"from": "start", "options": {"stage": matt["stage"]}})
        assert retried.status_code == 202, retried.text
        assert retried.json()["options"]["stage"]["meshes"][1]["material"]["kind"] == "diffuse"


async def test_meshes_of_others_are_not_read(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        body = await render_of(http, service, {"leaf.obj": LEAF})
        other = await client_with_token(service, "eve", "write")
        for files_id in (body["files_id"], str(uuid.uuid4())):
            answer = await http.post(
                "/v1/jobs", json=staged({**body, "files_id": files_id}, "leaf.obj"), headers=other
            )
            assert answer.status_code == 422 and answer.json()["type"].endswith(":input")


async def test_check_that_goes_on_after_its_answer_takes_one_thread_of_its_owner(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, may_end = threading.Semaphore(0), threading.Event()
    run_parser = mesh_check.run_parser

    def run_late(*given: Any) -> Any:
        begun.release()
        assert may_end.wait(300)
        return run_parser(*given)

    monkeypatch.setattr(mesh_check, "run_parser", run_late)
    async with connect_service() as (http, service):
        body = staged(await render_of(http, service, {"leaf.obj": LEAF}), "leaf.obj")
        monkeypatch.setattr(glass_meshes, "WAIT_SECONDS", 2)
        for _ in range(2):  # neither is answered by its check, and the second one must not begin
            made = await http.post("/v1/jobs", json=body)
            assert made.status_code == 202, made.text
        assert begun.acquire(timeout=60) and not begun.acquire(timeout=1)
        monkeypatch.setattr(glass_meshes, "WAIT_SECONDS", 600)
        asked = asyncio.create_task(http.post("/v1/jobs", json=body))
        may_end.set()
        assert (await asked).status_code == 422
