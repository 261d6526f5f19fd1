"""Each blow of benchmarks/chaos.py once, while short jobs are in flight: none is lost or done twice."""

import random
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks.chaos import Run, journal_faults, make_scene, prepare, undisturbed_reconstruction
from benchmarks.chaos_machine import BLOWS, Machine, small_disk

pytestmark = pytest.mark.heavy


@pytest.fixture
def machine(short_root: Path) -> Iterator[Machine]:
    folder = short_root / "chaos"
    with small_disk(folder, 400) as small:
        machine = Machine(folder, slots=3, small=small)
        machine.start()
        yield machine
        machine.stop()


@pytest.mark.exhaustive
def test_jobs_survive_random_kills(machine: Machine, tmp_path: Path) -> None:
    scene = make_scene(tmp_path / "scene")
    expected = undisturbed_reconstruction(scene, tmp_path / "undisturbed")
    run = Run(machine, scene, random.Random(5), expected)
    gate = tmp_path / "gate"
    prepare(run, chains=0, reconstructions=0, steps=0, seconds=0)
    run.submit_chain(31, 0.02, gate=str(gate))
    (held,) = run.accepted
    checkpoint: dict[str, Any] | None = None
    while checkpoint is None or checkpoint["step"] < 30:
        time.sleep(0.1)
        checkpoint = run.patiently(lambda api: api.get(f"/v1/jobs/{held}"))["checkpoint"]
    prepare(run, chains=4, reconstructions=1, steps=35, seconds=0.08)
    for blow in BLOWS:
        run.submit_chain(35, 0.08)
        run.strike(blow)
    gate.touch()
    assert run.in_flight_before[0] > machine.slots and min(run.in_flight_before) >= 2
    run.settle(1500)
    assert run.faults() == [], machine.log.read_text()[-8000:]
    report = run.report()
    assert report["attempts"] > report["jobs"] and report["resumed_from_a_checkpoint"] > 0
    print(report)  # noqa: T201 - shown on request


def state(id_: int, attempt: int, name: str) -> dict[str, Any]:
    return {"id": id_, "attempt": attempt, "kind": "state", "data": {"state": name}}


def event(id_: int, attempt: int, kind: str, **data: Any) -> dict[str, Any]:
    return {"id": id_, "attempt": attempt, "kind": kind, "data": data}


GOOD = [
    state(1, 0, "queued"), state(2, 1, "running"), event(3, 1, "stage_started", stage="train"),
    event(4, 1, "checkpoint", stage="train", step=5), state(5, 2, "running"),
    event(6, 2, "resumed", stage="train", step=5), event(7, 2, "stage_started", stage="train"),
    event(8, 2, "progress", stage="train", step=7), state(9, 2, "succeeded"),
]  # fmt: skip


def test_chaos_check_reports_injected_faults() -> None:
    assert journal_faults(GOOD) == []
    assert journal_faults(GOOD[:-1]) == ["it ended 0 times"]
    assert journal_faults([*GOOD, state(10, 2, "failed")]) == ["it ended 2 times"]
    assert journal_faults([*GOOD, event(10, 1, "checkpoint", step=9)]) == ["it went on after its end"]
    anew = [each for each in GOOD if each["kind"] != "resumed"]
    assert journal_faults(anew) == ["attempt 2 began anew although there was a checkpoint at 5"]
    behind = [*GOOD[:7], event(8, 2, "progress", stage="train", step=1), GOOD[-1]]
    assert journal_faults(behind) == ["attempt 2 was at 1 although it had 5"]
