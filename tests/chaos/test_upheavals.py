"""The front end is started again, the clock jumps, tables are changed: jobs, workers and clients go on."""

import random
from pathlib import Path

import pytest

from benchmarks.chaos import Run, make_scene
from benchmarks.chaos_machine import Machine
from benchmarks.chaos_upheavals import UPHEAVALS, report, upheave

pytestmark = pytest.mark.heavy


@pytest.mark.exhaustive
def test_jobs_survive_random_faults(short_root: Path, tmp_path: Path) -> None:
    # No worker is lost, and one that a busy machine keeps waiting is not to be missed.
    machine = Machine(short_root / "upheavals", slots=2, settings={"STALE_SECONDS": "30"})
    machine.start()
    folder = short_root / "clients"
    folder.mkdir()
    try:
        those = upheave(Run(machine, make_scene(tmp_path / "scene"), random.Random(0), {}), folder)
        assert those.faults == [], machine.log.read_text()[-8000:]
        numbers = report(those)
    finally:
        machine.stop()
    assert len(numbers["blows"]) == len(UPHEAVALS) == 4 and numbers["least_in_flight_at_a_blow"] >= 4
    assert numbers["commands"] >= 10 and numbers["commands_failed"] == 0
    print(numbers)  # noqa: T201 - shown on request
