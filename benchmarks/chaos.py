"""Everything is killed, frozen and starved at random while short jobs run; nothing may be lost by it.

    python -m benchmarks.chaos --minutes 10     # prints a report as JSON; exit code 1 if there are faults
    python -m benchmarks.chaos --minutes 60 --seed 7 --reconstructions 6 --gluttons 12

What must hold at the end, for every job that was accepted:

* it is in one terminal state, told of once;
* it has one published result, whose files have the digests that the tables say;
* they are byte for byte those of a run that nobody disturbed;
* no attempt began anew once there was a checkpoint.

Gluttons, which write until the disk is full, have failed instead, for that reason.

Needs root for the disk that fills up; without, that blow and the gluttons are left out.
"""

import argparse
import hashlib
import json
import random
import sys
import tempfile
import threading
import time
import uuid
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx

from benchmarks.chaos_kind import ChainOptions, undisturbed
from benchmarks.chaos_machine import BLOWS, Blow, Machine, small_disk
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.operations.reconstruct import options_from_json
from octasplat.engine.pipeline import reconstruct
from octasplat.workers.client.api import Api, ServiceError, ServiceUnreachableError
from octasplat.workers.client.upload import list_scene_files, upload_scene
from octasplat.workers.storage.factory import open_storage
from octasplat.workers.storage.trees import read_manifest

IN_FLIGHT = 20
OVER = ("succeeded", "failed", "canceled")
GLUTTON = "glutton"
TRAIN = {
    "iterations": 150, "rays_per_batch": 256, "sh_degree": 1, "max_gaussians": 300, "initial_points": 250,
    "densify_from_iter": 10, "rebuild_every": 25, "checkpoint_every": 25, "probe_rays": 256,
}  # fmt: skip
RECONSTRUCTION: dict[str, Any] = {"preset": "fast", "train": TRAIN}
COMPARED = ("chain.bin", "scene.ply", "octagons.ply", "octagons.obj", "octagons.glb", "held_out.json")
MAX_RETRIES = 3


@dataclass
class Run:
    """A run of chaos.

    Args:
        machine: running.
        scene: the photographs.
        chance: decides everything.
        expected: contents of the results of an undisturbed reconstruction by name.
    """

    machine: Machine
    scene: Path
    chance: random.Random
    expected: dict[str, bytes]
    dataset: str = ""
    photographs: dict[str, bytes] = field(default_factory=dict)
    accepted: dict[str, dict[str, Any]] = field(default_factory=dict)
    retried: Counter[str] = field(default_factory=Counter)
    blows: Counter[str] = field(default_factory=Counter)
    resumed: int = 0
    in_flight_before: list[int] = field(default_factory=list)

    def patiently(self, ask: Any, seconds: float = 600.0) -> Any:
        """What a request brings, asked again for as long as the service is away."""
        deadline = time.monotonic() + seconds
        while True:
            try:
                with Api(self.machine.address, self.machine.token) as api:
                    return ask(api)
            except (ServiceUnreachableError, ServiceError, httpx.HTTPError) as error:
                refused = isinstance(error, ServiceError) and error.status not in (500, 502, 503, 504, 507)
                if refused or time.monotonic() > deadline:
                    raise
                time.sleep(0.2)

    def submit(self, body: dict[str, Any]) -> None:
        """Have a job accepted, once, however often that takes."""
        key = uuid.uuid4().hex
        job = self.patiently(lambda api: api.post("/v1/jobs", body, key=key))
        assert job["id"] not in self.accepted, "the same job was accepted twice"
        self.accepted[job["id"]] = job

    def submit_chain(self, steps: int, seconds: float, gate: str = "") -> None:
        """Submit a short job."""
        options = {"seed": len(self.accepted), "steps": steps, "seconds": seconds, "gate": gate}
        self.submit({"kind": "chain", "dataset_id": self.dataset, "options": options})

    def submit_reconstruction(self) -> None:
        """Submit a small one of the real kind."""
        self.submit({"dataset_id": self.dataset, "options": RECONSTRUCTION})

    def submit_glutton(self) -> None:
        """Submit a job that fills the disk."""
        self.submit({"kind": GLUTTON, "dataset_id": self.dataset})

    def in_flight(self) -> int:
        """Accepted jobs that are not over."""
        active = self.patiently(
            lambda api: sum(
                1
                for _ in api.iterate_pages(
                    "/v1/jobs", "jobs", state=["queued", "running", "canceling"], limit=200
                )
            )
        )
        return int(active)

    def strike(self, blow: Blow) -> None:
        """Do one of the blows."""
        self.in_flight_before.append(self.in_flight())
        self.blows[blow.__name__] += 1
        blow(self.machine, self.chance)

    def settle(self, seconds: float) -> None:
        """Wait until every job is over; those failed for having lost too many workers are asked for again."""
        deadline = time.monotonic() + seconds
        open_jobs = set(self.accepted)
        while open_jobs:
            for job_id in sorted(open_jobs):
                job = self.patiently(lambda api, job_id=job_id: api.get(f"/v1/jobs/{job_id}"))
                if job["state"] == "failed" and self.retried[job_id] < MAX_RETRIES and _is_poison(job):
                    self.retried[job_id] += 1
                    self.patiently(lambda api, job_id=job_id: api.post(f"/v1/jobs/{job_id}/retry"))
                elif job["state"] in OVER:
                    open_jobs.discard(job_id)
            if time.monotonic() > deadline:
                return
            time.sleep(0.5)

    def faults(self) -> list[str]:
        """What is wrong, in sentences."""
        found: list[str] = []
        storage = open_storage(self.machine.data / "store", floor_bytes=0)
        with Api(self.machine.address, self.machine.token) as api:
            listed = {job["id"]: job for job in api.iterate_pages("/v1/jobs", "jobs", limit=200)}
            if set(listed) != set(self.accepted):
                found.append(f"{len(self.accepted)} jobs were accepted and {len(listed)} are there")
            for job_id in self.accepted:
                job = listed.get(job_id)
                if job is None or not _ended_well(job):
                    found.append(f"job {job_id} ended {job and (job['state'], job['error'])}")
                    continue
                events = timeline(api, job_id)
                self.resumed += sum(event["kind"] == "resumed" for event in events)
                found += [f"job {job_id}: {fault}" for fault in journal_faults(events, self.retried[job_id])]
                if job["kind"] == GLUTTON:
                    continue
                results: dict[str, str] = {}
                for artifact in api.get(f"/v1/jobs/{job_id}/artifacts")["artifacts"]:
                    content = api.request("GET", f"/v1/jobs/{job_id}/artifacts/{artifact['name']}").content
                    if hashlib.sha256(content).hexdigest() != artifact["sha256"]:
                        found.append(f"job {job_id}: {artifact['name']} does not have its digest")
                    results[artifact["name"]] = artifact["sha256"]
                    if _is_compared(artifact["name"]) and content != self._undisturbed(
                        api, job, artifact["name"]
                    ):
                        found.append(f"job {job_id}: {artifact['name']} differs from the undisturbed run's")
                manifests = [
                    {file.path: file.sha256 for file in manifest.files}
                    for attempt in range(1, job["attempt"] + 1)
                    if (manifest := read_manifest(storage, f"results/{job_id}/{attempt}")) is not None
                ]
                if manifests.count(results) < 1 or not any(map(_is_compared, results)):
                    found.append(f"job {job_id}: its results are not those of one attempt")
        return found

    def report(self) -> dict[str, Any]:
        """Numbers of the run, after :meth:`faults`."""
        with Api(self.machine.address, self.machine.token) as api:
            jobs = list(api.iterate_pages("/v1/jobs", "jobs", limit=200))
        return {
            "jobs": len(self.accepted),
            "kinds": dict(Counter(job["kind"] for job in jobs)),
            "states": dict(Counter(job["state"] for job in jobs)),
            "blows": dict(self.blows),
            "in_flight_at_the_first_blow": self.in_flight_before[0],
            "least_in_flight_at_a_blow": min(self.in_flight_before),
            "attempts": sum(job["attempt"] for job in jobs),
            "most_attempts": max(job["attempt"] for job in jobs),
            "resumed_from_a_checkpoint": self.resumed,
            "asked_for_again": sum(self.retried.values()),
        }

    def _undisturbed(self, api: Api, job: dict[str, Any], name: str) -> bytes | None:
        if job["kind"] == "chain":
            options = api.get(f"/v1/jobs/{job['id']}")["options"]
            return undisturbed(self.photographs, ChainOptions.model_validate(options))
        return self.expected.get(name)


def journal_faults(events: list[dict[str, Any]], retries: int = 0) -> list[str]:
    """What the journal of a job tells that should never happen.

    Args:
        events: of a job that is over.
        retries: how often it was asked for again after it had failed.
    """
    found = []
    ends = [event for event in events if event["kind"] == "state" and event["data"]["state"] in OVER]
    if len(ends) != 1 + retries:
        found.append(f"it ended {len(ends)} times")
    elif events[-1]["id"] != ends[-1]["id"]:
        found.append("it went on after its end")
    kept: int | None = None
    resumed: dict[int, int] = {}
    had: dict[int, int | None] = {}
    for event in events:
        step, attempt = event["data"].get("step"), event["attempt"]
        if event["kind"] == "checkpoint":
            kept = step
        elif event["kind"] == "resumed":
            resumed[attempt] = step
            if step != kept:
                found.append(f"attempt {attempt} went on from {step} and not from {kept}")
        elif event["kind"] == "progress" and event["data"].get("stage") in (None, "train"):
            reached = event["data"].get("iteration", step)
            if reached < resumed.get(attempt, 0):
                found.append(f"attempt {attempt} was at {reached} although it had {resumed[attempt]}")
        elif event["kind"] == "state" and event["data"]["state"] == "running":
            had[attempt] = kept
        elif event["kind"] == "stage_started" and had.get(attempt) is not None and attempt not in resumed:
            found.append(f"attempt {attempt} began anew although there was a checkpoint at {had[attempt]}")
    return found


def timeline(api: Api, job_id: str) -> list[dict[str, Any]]:
    """All events of a job."""
    events: list[dict[str, Any]] = []
    after = 0
    while True:
        page = api.get(f"/v1/jobs/{job_id}/timeline", after=after, limit=5000)
        events += page["events"]
        if not page["events"]:
            return events
        after = page["next"]


def _ended_well(job: dict[str, Any]) -> bool:
    if job["kind"] == GLUTTON:
        return job["state"] == "failed" and job["error"]["type"] == "no_space"
    return bool(job["state"] == "succeeded")


def _is_poison(job: dict[str, Any]) -> bool:
    return job["error"]["type"] in ("worker_lost", "crashed") and job["rescues"] >= 3


def _is_compared(name: str) -> bool:
    return name in COMPARED or name.startswith("renders/")


def make_scene(folder: Path) -> Path:
    """A generated scene of eight tiny photographs."""
    config = SyntheticDatasetConfig(views=8, width_px=32, height_px=24, samples_per_side=1, points=300)
    write_synthetic_dataset(folder, config)
    return folder


def undisturbed_reconstruction(scene: Path, folder: Path) -> dict[str, bytes]:
    """Contents by name of what must not depend on what happens on the way."""
    run = reconstruct(scene, folder, options_from_json(RECONSTRUCTION).config(), threads=1)
    files = (path for path in run.rglob("*") if path.is_file())
    named = {path.relative_to(run).as_posix(): path for path in files}
    return {name: path.read_bytes() for name, path in named.items() if _is_compared(name)}


def prepare(run: Run, *, chains: int, reconstructions: int, steps: int, seconds: float) -> None:
    """Upload the scene and fill the queue."""
    listed = run.patiently(lambda api: list_scene_files(api, run.scene))
    run.photographs = {file.name: file.path.read_bytes() for file in listed}
    run.dataset = run.patiently(lambda api: upload_scene(api, run.scene))["id"]
    for number in range(max(chains, reconstructions)):
        if number < reconstructions:
            run.submit_reconstruction()
        if number < chains:
            run.submit_chain(steps, seconds)


def main() -> int:
    """Run for as long as asked."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--slots", type=int, default=4, help="jobs at once")
    parser.add_argument("--reconstructions", type=int, default=4, help="real ones among the jobs")
    parser.add_argument("--gluttons", type=int, default=6, help="jobs that fill the disk, one after another")
    parser.add_argument("--disk-mib", type=int, default=400)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="octasplat-chaos-") as name:
        root = Path(name)
        root.chmod(0o711)
        with small_disk(root / "d", options.disk_mib) as small:
            report, faults = _whole(root, small, options)
    print(json.dumps({**report, "faults": faults}, indent=1))
    return 1 if faults else 0


def _whole(root: Path, small: bool, options: argparse.Namespace) -> tuple[dict[str, Any], list[str]]:
    scene = make_scene(root / "scene")
    expected = undisturbed_reconstruction(scene, root / "undisturbed")
    machine = Machine(root / "d", options.slots, small)
    machine.start()
    run = Run(machine, scene, random.Random(options.seed), expected)
    began = time.monotonic()
    stop = threading.Event()
    try:
        reconstructions = options.reconstructions
        prepare(run, chains=IN_FLIGHT + 8, reconstructions=reconstructions, steps=80, seconds=0.1)

        def keep_busy() -> None:
            while not stop.is_set():
                for _ in range(max(0, IN_FLIGHT + 8 - run.in_flight())):
                    run.submit_chain(80, 0.1)
                stop.wait(1.0)

        busy = threading.Thread(target=keep_busy)
        busy.start()
        gluttons = options.gluttons if small else 0
        feasts = [began + options.minutes * 60 * number / gluttons for number in range(gluttons)]
        try:
            while time.monotonic() - began < options.minutes * 60:
                while feasts and time.monotonic() > feasts[0]:
                    feasts.pop(0)
                    run.submit_glutton()
                blow = run.chance.choice(BLOWS)
                print(f"{time.monotonic() - began:7.1f} s  {blow.__name__}", file=sys.stderr, flush=True)
                run.strike(blow)
                time.sleep(run.chance.uniform(0.5, 6.0))
        finally:
            stop.set()
            busy.join()
        run.settle(900)
        faults = run.faults()
        return {**run.report(), "seconds": round(time.monotonic() - began)}, faults
    finally:
        machine.stop()


if __name__ == "__main__":
    raise SystemExit(main())
