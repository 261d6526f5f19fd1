"""A job keeps which settings were asked for where it is trained without its materials."""

import asyncio
import json
import uuid
from pathlib import Path
from typing import Any

import pytest

import octasplat as osp
from tests.service.conftest import connect_service
from tests.support.service_harness import ConnectService
from tests.support.stored_dataset import store_dataset
from tests.support.tiny_dataset import make_tiny_dataset
from tests.support.worker_harness import WorkerHarness

__all__ = ["connect_service"]

pytestmark = pytest.mark.heavy

MAX_WAIT_SECONDS = 1200.0
TRAIN = {"iterations": 2, "initial_points": 50, "max_gaussians": 100}
PLAIN: dict[str, Any] = {"preset": "fast", "train": TRAIN, "test_every": 4, "exports": []}


async def test_job_without_its_materials_has_the_bytes_of_a_run_without_them(
    connect_service: ConnectService, conninfo: str, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    scene = make_tiny_dataset(tmp_path_factory, width_px=24, height_px=18)
    expected = osp.reconstruct(scene, tmp_path / "expected", **PLAIN, rays_per_batch=8192, threads=1)
    other = osp.reconstruct(scene, tmp_path / "other", **PLAIN, threads=1)
    bench = WorkerHarness(conninfo, tmp_path)
    try:
        async with connect_service() as (http, _service):
            dataset = await asyncio.to_thread(store_dataset, bench, scene)
            modules = json.dumps(["tests.support.unexplained_photographs"])
            await asyncio.to_thread(bench.worker, KIND_MODULES=modules)
            for given, run in (({"rays_per_batch": 8192}, expected), ({}, other)):
                options = {**PLAIN, **given, "materials": True}
                body = {"kind": "reconstruct", "dataset_id": str(dataset), "options": options}
                answer = await http.post("/v1/jobs", json=body)
                assert answer.status_code == 202, answer.text
                job = uuid.UUID(answer.json()["id"])
                done = await asyncio.to_thread(bench.wait_until_finished, job, MAX_WAIT_SECONDS)
                assert done.state == "succeeded", bench.worker_logs()
                results = await asyncio.to_thread(bench.results, job)
                assert json.loads(results["config.json"])["material_choice"] == "none"
                assert results["scene.ply"] == (run.path / "scene.ply").read_bytes()
    finally:
        await asyncio.to_thread(bench.close)
