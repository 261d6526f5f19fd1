import json
import re

import numpy as np
import pytest
from PIL import Image

from benchmarks.curves import main, read_run


@pytest.fixture
def run(tmp_path):
    """A run's folder with what the curves are drawn from; twice as long by the clock as the training."""

    def make(name, psnrs, **files):
        folder = tmp_path / name
        folder.mkdir()
        rows = [{"time": 100.0, "kind": "stage_started", "stage": "load"}]
        for k, psnr in enumerate(psnrs):
            at = {"iteration": 500 * k, "seconds": 10.0 * k, "gaussians": 7}
            rows.append({"kind": "held_out_measured", "psnr": psnr, **at})
            rows.append({"kind": "training_progress", "psnr": psnr + 2, **at})
        rows.append({"time": 100 + 20.0 * (len(psnrs) - 1), "kind": "stage_finished", "stage": "export"})
        text = "".join(json.dumps(row) + "\n" for row in rows)
        (folder / "events.jsonl").write_text(text + '{"kind": "trai')  # a kill cut it short
        for file, content in files.items():
            (folder / f"{file}.json").write_text(json.dumps(content))
        return folder

    return make


def test_curves_equal_run_events(run):
    ends = {"metrics": {"mean": {"psnr": 25.5}}, "training": {"training_views": {"psnr": 27.25}}}
    found = read_run(run("a", [20.0, 23.0, 25.0], **ends), "room:now")
    assert (found.panel, found.label) == ("room", "now")
    assert found.held_out == [(0.0, 20.0), (10.0, 23.0), (20.0, 25.0)]
    assert found.trained == [(0.0, 22.0), (10.0, 25.0), (20.0, 27.0)]
    assert (found.held_out_end, found.trained_end) == (25.5, 27.25)


def test_earlier_runs_note_less_and_cpu_seconds_stretch_the_time(run):
    found = read_run(run("b", [20.0, 23.0, 25.0], training={"seconds": 1.0}), cpu_seconds=120.0)
    assert (found.panel, found.label, found.held_out_end, found.trained_end) == ("", "b", None, None)
    assert found.held_out == [(0.0, 20.0), (30.0, 23.0), (60.0, 25.0)]


def test_cpu_seconds_exclude_suspension(run):
    folder = run("d", [20.0] * 101)
    rows = (folder / "events.jsonl").read_text().splitlines()
    late = [json.loads(row) for row in rows[:-1]]
    for row in late[-60:]:
        row["time" if "time" in row else "seconds"] += 5000
    (folder / "events.jsonl").write_text("".join(json.dumps(row) + "\n" for row in late))
    times = [x for x, _ in read_run(folder, cpu_seconds=1000.0).held_out]
    assert times[-1] < 1000 and max(np.diff(times)) < 0.25 * times[-1]


def test_curves_of_several_runs_share_plot(run, tmp_path, capsys):
    folders = run("a", [20.0, 23.0, 25.0]), run("b", [20.0, 25.0]), run("c", [14.0, 15.0])
    picture = tmp_path / "curves.png"
    main([f"{folders[0]}=x:old", f"{folders[1]}=x:new", f"{folders[2]}=y:new", "-o", str(picture)])
    pixels = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    assert pixels.shape[1] > 2 * pixels.shape[0]  # a panel for each scene
    half = pixels.shape[1] // 2
    for color, in_first, in_second in (((31, 119, 180), True, True), ((255, 127, 14), True, False)):
        there = (np.abs(pixels - color).max(axis=-1) < 8).sum(axis=0)
        assert (there[:half].sum() > 50, there[half:].sum() > 50) == (in_first, in_second)
    assert re.search(r"x old: held out 25\.00 dB after 20 s\n", capsys.readouterr().out)


def test_curves_not_a_run_is_refused(run, tmp_path, capsys):
    with pytest.raises(SystemExit, match=r"empty/events\.jsonl tells of no training"):
        main([str(tmp_path / "empty"), "-o", str(tmp_path / "curves.png")])
    with pytest.raises(SystemExit):
        main([str(run("a", [1.0])), "-o", str(tmp_path / "c.png"), "--cpu-seconds", "1", "2"])
    assert "one number for each of the 1 runs" in capsys.readouterr().err
    assert not (tmp_path / "curves.png").exists()
