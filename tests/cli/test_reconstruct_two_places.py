"""``octasplat reconstruct`` on photographs of two places that nothing links."""

import json
from pathlib import Path

import pytest

from tests.support.room_corners import write_corner

pytestmark = pytest.mark.heavy


@pytest.mark.exhaustive
def test_larger_place_is_trained_and_the_other_one_can_be(octasplat, tmp_path, tiny):
    photographs = tmp_path / "photographs"
    larger = write_corner(photographs, "a", 7, seed=1)
    smaller = write_corner(photographs, "b", 5, seed=2)
    runs = [tmp_path / "one", tmp_path / "two"]
    for threads, output in enumerate(runs, start=1):
        done = octasplat(
            "reconstruct", photographs, "-o", output, "--max-side", "64", *tiny, "--threads", threads
        )
        assert done.exit_code == 0, done.stderr
        other = output / "poses" / "1"
        sentence = f"{other} of 5 photographs, 5 of them not in that one (b00.png, b01.png, b02.png, ...)"
        assert sentence in done.stderr and sentence in done.stdout
        events = (output / "events.jsonl").read_text().splitlines()
        assert sentence in json.dumps([json.loads(line) for line in events])
        assert "b00.png, b01.png, b02.png" in (output / "report.html").read_text()
    one, two = ({p.relative_to(r): p.read_bytes() for p in (r / "poses").rglob("*.*")} for r in runs)
    assert one == two and Path("poses/1/images.bin") in one
    record = json.loads((runs[0] / "poses" / "poses.json").read_text())
    assert record["left_out"] == smaller
    assert record["other_models"] == [{"folder": "1", "placed": 5, "not_in_taken": smaller}]
    metrics = json.loads((runs[0] / "metrics.json").read_text())
    assert metrics["poses"]["other_models"] == [{"model": "poses/1", "placed": 5, "not_in_taken": 5}]

    output = tmp_path / "three"
    of_other = ("--model", runs[0] / "poses" / "1", "--max-side", "64", *tiny)
    done = octasplat("reconstruct", photographs, "-o", output, *of_other)
    assert done.exit_code == 0, done.stderr
    assert "features" not in done.stdout and f"{output / 'poses' / '0'} of 7 photographs" in done.stderr
    views = json.loads((output / "views.json").read_text())["views"]
    assert [view["name"] for view in views] == smaller
    assert json.loads((output / "config.json").read_text())["reconstruction"]["model"] == "poses/1"
    again = octasplat("reconstruct", photographs, "-o", output, "--resume", *of_other)
    assert again.exit_code == 0, again.stderr
    assert json.loads((output / "poses" / "0" / "poses.json").read_text())["left_out"] == smaller
    assert larger == [name for name in record_names(output) if name.startswith("a")]


def record_names(output: Path) -> list[str]:
    """Return the photographs that the model of a run leaves out."""
    names: list[str] = json.loads((output / "poses" / "poses.json").read_text())["left_out"]
    return names
