"""A day's work in an hour: five owners queue short jobs while all that works is upgraded, drained and killed.

    python -m benchmarks.day --jobs 500 --minutes 60    # a report as JSON; exit code 1 if there are faults

Four workers and a front end of the release before begin. After a tenth of the time the front end and then one
worker after another is replaced by this version's; all the time workers are drained and killed, as are
programs of jobs and the front end. The owners have their own ways:

    morning     queues all of its jobs at the start
    afternoon   all at half time
    bursts      a fifth of them, five times
    steady      one now and then
    long        one now and then, each of which takes four times as long

What must hold for each job is said in :mod:`benchmarks.chaos`; besides, nobody who has jobs in the queue
waits longer than ``--turn-seconds`` for one of them to begin.
"""

import argparse
import json
import random
import statistics
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

from benchmarks.chaos import Run, make_scene, prepare, timeline
from benchmarks.chaos_machine import ROOT
from benchmarks.fleet import Fleet, release
from octasplat.workers.client.api import Api

BEFORE = "8a6786e625c3"
"""The commit of the release before this one."""
WORKERS = 4
OWNERS = ("morning", "afternoon", "bursts", "steady", "long")
STEPS, STEP_SECONDS = 20, 0.05


@dataclass
class Door:
    """The service as one owner comes to it."""

    fleet: Fleet
    token: str

    @property
    def address(self) -> str:
        """Where the front end is at the moment."""
        return self.fleet.address

    @property
    def data(self) -> Path:
        """Folder with the store."""
        return self.fleet.data


def moments(owner: str, jobs: int) -> list[float]:
    """When the owner queues each of its jobs, as parts of the time."""
    match owner:
        case "morning":
            return [0.0] * jobs
        case "afternoon":
            return [0.5] * jobs
        case "bursts":
            return [0.2 * (5 * number // jobs) for number in range(jobs)]
    return [number / jobs for number in range(jobs)]


def queue_up(run: Run, owner: str, jobs: int, seconds: float) -> None:
    """Queue the jobs of an owner at their moments."""
    began = time.monotonic()
    for part in moments(owner, jobs):
        time.sleep(max(0.0, began + part * seconds - time.monotonic()))
        run.submit_chain(STEPS, STEP_SECONDS * (4 if owner == "long" else 1))


def disturb(fleet: Fleet, chance: random.Random, blows: Counter[str]) -> None:
    """One of the things that happen on a day."""
    name = chance.choice(fleet.workers)
    happenings: dict[str, Callable[[], Any]] = {
        "drained": lambda: fleet.drain_worker(name),
        "worker killed": lambda: fleet.kill_worker(name),
        "job's program killed": lambda: fleet.kill_job(name),
        "front end killed": fleet.kill_front,
    }
    what = chance.choices(list(happenings), weights=(4, 3, 4, 1))[0]
    blows[what] += 1
    happenings[what]()


def upgrades(fleet: Fleet) -> list[Callable[[], Any]]:
    """The steps from the release before to this version, in order."""

    def front() -> None:
        fleet.roots["front"] = ROOT
        fleet.start_front()

    def worker(name: str) -> None:
        fleet.roots[name] = ROOT
        fleet.drain_worker(name)

    return [front, *(lambda name=name: worker(name) for name in fleet.workers)]  # type: ignore[misc]


def waits(jobs: Sequence[dict[str, Any]], begins: dict[str, datetime]) -> dict[str, float]:
    """Waiting times of an owner's jobs, and its longest time with jobs in the queue of which none began.

    Args:
        jobs: of one owner.
        begins: when each was begun first, by its id.
    """
    queued = [(datetime.fromisoformat(job["created_at"]), begins[job["id"]]) for job in jobs]
    waited = sorted((begun - made).total_seconds() for made, begun in queued)
    turns = sorted(begun for _, begun in queued)
    longest = 0.0
    for before, turn in pairwise([datetime.min.replace(tzinfo=turns[0].tzinfo), *turns]):
        waiting = [made for made, begun in queued if begun >= turn and made < turn]
        if waiting:
            longest = max(longest, (turn - max(before, min(waiting))).total_seconds())
    return {
        "median_s": round(statistics.median(waited), 1),
        "p90_s": round(waited[int(0.9 * (len(waited) - 1))], 1),
        "most_s": round(waited[-1], 1),
        "longest_without_a_turn_s": round(longest, 1),
    }


def judge(run: Run, turn_seconds: float) -> tuple[dict[str, Any], list[str]]:
    """Figures of an owner, and faults."""
    faults, begins = run.faults(), {}
    with Api(run.machine.address, run.machine.token) as api:
        jobs = list(api.iterate_pages("/v1/jobs", "jobs", limit=200))
        for job in jobs:
            begun = [
                event["at"]
                for event in timeline(api, job["id"])
                if event["kind"] == "state" and event["data"]["state"] == "running"
            ]
            if begun:
                begins[job["id"]] = datetime.fromisoformat(begun[0])
    figures: dict[str, Any] = {
        "jobs": len(jobs),
        "states": dict(Counter(job["state"] for job in jobs)),
        "attempts": sum(job["attempt"] for job in jobs),
        "resumed_from_a_checkpoint": run.resumed,
        **waits([job for job in jobs if job["id"] in begins], begins),
    }
    if figures["longest_without_a_turn_s"] > turn_seconds:
        faults.append(f"had no turn for {figures['longest_without_a_turn_s']} s")
    return figures, faults


def main() -> int:
    """Run a day."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--jobs", type=int, default=500)
    parser.add_argument("--minutes", type=float, default=60.0, help="in which they are queued")
    parser.add_argument("--pause", type=float, default=10.0, help="seconds between disturbances")
    parser.add_argument("--turn-seconds", type=float, default=120.0)
    parser.add_argument("--before", default=BEFORE, metavar="COMMIT", help="the release to begin with")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="octasplat-day-") as name:
        root = Path(name)
        root.chmod(0o711)
        report = whole_day(root, options)
    print(json.dumps(report, indent=1))
    return 1 if report["faults"] else 0


def whole_day(root: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Begin, disturb, upgrade, wait for the end, judge."""
    before = release(options.before, root / "before")
    fleet = Fleet(root / "d", {"front": before, **{f"w{n}": before for n in range(1, WORKERS + 1)}})
    (root / "d").mkdir(mode=0o711)
    scene, chance, blows = make_scene(root / "scene"), random.Random(options.seed), Counter[str]()
    fleet.begin()
    try:
        tokens = {owner: fleet.command("token", "create", owner, "--scope", "write") for owner in OWNERS}
        runs = {owner: Run(Door(fleet, tokens[owner]), scene, chance, {}) for owner in OWNERS}  # type: ignore[arg-type]
        for run in runs.values():
            prepare(run, chains=0, reconstructions=0, steps=0, seconds=0)
        began, seconds = time.monotonic(), options.minutes * 60
        each = options.jobs // len(OWNERS)
        queues = [
            threading.Thread(target=queue_up, args=(run, owner, each, seconds)) for owner, run in runs.items()
        ]
        for thread in queues:
            thread.start()
        steps, next_step = upgrades(fleet), began + 0.1 * seconds
        upgraded = [0.0, 0.0]
        while any(thread.is_alive() for thread in queues) or steps or unfinished(runs):
            if steps and time.monotonic() > next_step:
                steps.pop(0)()
                next_step = time.monotonic() + 0.05 * seconds
                upgraded = [upgraded[0] or time.monotonic() - began, time.monotonic() - began]
                print(f"{time.monotonic() - began:7.1f} s  upgraded", file=sys.stderr, flush=True)
            disturb(fleet, chance, blows)
            blows["started again"] += len(fleet.revive())
            time.sleep(chance.uniform(0.5, 1.5) * options.pause)
        queued_and_done = time.monotonic() - began
        for run in runs.values():
            run.settle(600)
        found = {owner: judge(run, options.turn_seconds) for owner, run in runs.items()}
        lost = [
            f"{owner} queued {len(run.accepted)}" for owner, run in runs.items() if len(run.accepted) != each
        ]
        return {
            "jobs": sum(len(run.accepted) for run in runs.values()),
            "seconds": round(queued_and_done),
            "upgraded_from_s_to_s": [round(moment) for moment in upgraded],
            "disturbances": dict(blows),
            "owners": {owner: figures for owner, (figures, _) in found.items()},
            "faults": lost
            + [f"{owner}: {fault}" for owner, (_, faults) in found.items() for fault in faults],
        }
    finally:
        fleet.end()


def unfinished(runs: dict[str, Run]) -> bool:
    """Whether somebody has jobs that are not over."""
    return any(run.in_flight() for run in runs.values())


if __name__ == "__main__":
    raise SystemExit(main())
