"""Every step of the images in a bare chroot, and the service that comes of them.

It takes minutes, so it is done only where ``OCTASPLAT_CHROOT_IMAGES=1`` asks for it.
"""

import os
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from moto.server import ThreadedMotoServer
from psycopg.conninfo import conninfo_to_dict, make_conninfo
from test_docker_files import compose

from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.workers.client.api import Api
from octasplat.workers.client.download import download_results
from octasplat.workers.client.submission import Submission, submit
from octasplat.workers.client.watch import watch_job
from tests.support.image_in_chroot import ChrootImage, build_image, missing_requirement
from tests.support.namespaces import forward_socket

pytestmark = [
    pytest.mark.heavy,
    pytest.mark.skipif(
        "OCTASPLAT_CHROOT_IMAGES" not in os.environ, reason="OCTASPLAT_CHROOT_IMAGES is not set"
    ),
    pytest.mark.skipif(missing_requirement() is not None, reason=str(missing_requirement())),
]
FEW = {
    "iterations": 60, "rays_per_batch": 256, "max_gaussians": 400, "initial_points": 300, "probe_rays": 256,
}  # fmt: skip
TOKEN = "octa_of_this_test_in_Containers"


@pytest.fixture(scope="module")
def front_end(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ChrootImage]:
    with build_image("front-end", tmp_path_factory.mktemp("front-end")) as image:
        yield image


@pytest.fixture(scope="module")
def worker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ChrootImage]:
    arguments = {"TORCH_INDEX": os.environ.get("TORCH_INDEX", "")}
    with build_image("worker-cpu", tmp_path_factory.mktemp("worker-cpu"), arguments) as image:
        yield image


@pytest.fixture
def database(conninfo: str) -> Iterator[str]:
    """The database over TCP, as containers reach it."""
    facts = conninfo_to_dict(conninfo)
    with forward_socket(f"{facts['host']}/.s.PGSQL.{facts['port']}", "127.0.0.1") as port:
        yield make_conninfo(conninfo, host="127.0.0.1", port=port)


def test_images_work_together(
    front_end: ChrootImage, worker: ChrootImage, database: str, tmp_path: Path
) -> None:
    store = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    store.start()
    services = compose()["services"]
    given = {
        "DATABASE_URL": database, "OCTASPLAT_FLOOR_BYTES": "0",
        "OCTASPLAT_STORAGE": services["worker"]["environment"]["OCTASPLAT_STORAGE"],
        "AWS_ENDPOINT_URL_S3": f"http://127.0.0.1:{store.get_host_and_port()[1]}",
        "AWS_ACCESS_KEY_ID": "octasplat", "AWS_SECRET_ACCESS_KEY": "secret",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_EC2_METADATA_DISABLED": "true",
    }  # fmt: skip
    script = compose()["configs"]["bucket"]["content"]
    (front_end.root / "bucket.py").write_text(script)
    processes: list[subprocess.Popen[bytes]] = []
    try:
        assert front_end.start("python3", "/bucket.py", **given).wait(60) == 0, front_end.log()
        # One port of this machine for all; in containers each has its own.
        front = front_end.start(**given, OCTASPLAT_TOKEN=TOKEN, OCTASPLAT_PORT="8643")
        maintenance = front_end.start(*services["maintenance"]["command"], **given)
        worker_ = worker.start(**given)
        processes += [front, maintenance, worker_]
        deadline = time.monotonic() + 60
        health = [part.replace("8642", "8643") for part in front_end.health]
        while subprocess.run(
            front_end.wrapped(*health), env=front_end.environment, capture_output=True
        ).returncode:
            assert front.poll() is None and time.monotonic() < deadline, front_end.log()
            time.sleep(0.3)
        scene = tmp_path / "scene"
        config = SyntheticDatasetConfig(views=8, width_px=48, height_px=36, samples_per_side=1, points=500)
        write_synthetic_dataset(scene, config)
        with Api("http://127.0.0.1:8643", TOKEN) as api:
            job = submit(api, Submission(scene, {"preset": "fast", "train": FEW}))
            done = watch_job(api, job["id"], lambda _event: None, lambda _state: None)
            assert done["state"] == "succeeded", (done, worker.log())
            assert {"viewer.glb", "metrics.json"} <= {
                path.name for path in download_results(api, job["id"], tmp_path / "result")
            }
        codes = [ChrootImage.stop(process) for process in processes]
        # uvicorn ends by the signal that asked it to, once it is done.
        assert codes[0] in (0, 143) and codes[1:] == [0, 0], (codes, front_end.log() + worker.log())
    finally:
        for process in processes:
            ChrootImage.kill(process)
        store.stop()
    owner = (worker.root / "data").stat()
    assert (owner.st_uid, oct(owner.st_mode & 0o777)) == (10001, "0o711")
