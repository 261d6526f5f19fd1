"""What the displays show of the engine's events."""

import io
import json
import re
import time
from dataclasses import replace

import pytest
from rich.console import Console

from octasplat.engine.core.durations import format_clock, format_duration
from octasplat.engine.core.errors import CancelledError
from octasplat.engine.core.events import (
    CheckpointWritten,
    HeldOutMeasured,
    ImagesSaved,
    PhaseFinished,
    PhaseProgress,
    PhaseStarted,
    RunFinished,
    TrainingProgress,
    Warned,
    parse_event,
)
from octasplat.engine.core.progress import stop_when_asked
from octasplat.workers.cli.progress import ProgressBars, show_progress
from octasplat.workers.reporting.event_lines import EventLines, ProgressState
from octasplat.workers.reporting.wording import format_rate

TRAINING = TrainingProgress(
    iteration=310, total_iterations=1500, loss=0.1, psnr=24.13, gaussians=32000, rays_per_second=310_400,
    hits_per_ray=9.0, seconds=20.0, seconds_left=83.2,
)  # fmt: skip
HELD_OUT = HeldOutMeasured(iteration=250, psnr=23.04, gaussians=30000, seconds=17.0)
STATE = "training 24.1 dB, held out 23.0 dB, 32,000 Gaussians, 310k rays/s"


def test_plain_lines_show_training_state():
    lines = []
    show = EventLines(lines.append, interval_seconds=0.0)
    for event in (PhaseStarted("train", 1500), HELD_OUT, TRAINING, PhaseFinished("train", 83.4)):
        show(event)
    assert lines == [
        "Training",
        f"  310/1500: {STATE}, 1:23 left",
        f"Trained 310 iterations in 1:23 min: {STATE}",
    ]


def test_held_out_views_measured_before_the_training_are_not_shown_as_its_state():
    lines = []
    show = EventLines(lines.append, interval_seconds=0.0)
    for event in (PhaseStarted("train", 1500), replace(HELD_OUT, iteration=0), TRAINING, HELD_OUT, TRAINING):
        show(event)
    assert lines == [
        "Training",
        f"  310/1500: {STATE.replace('held out 23.0 dB, ', '')}, 1:23 left",
        f"  310/1500: {STATE}, 1:23 left",
    ]


def test_time_left_follows_the_work_where_steps_differ(monkeypatch):
    clock = iter((0.0, 60.0))
    monkeypatch.setattr("octasplat.workers.reporting.time_left.time.monotonic", lambda: next(clock))
    state = ProgressState()
    state.update(PhaseStarted("export", 5))
    state.update(PhaseProgress("export", 0, 5, work_done=0.0))
    state.update(PhaseProgress("export", 1, 5, work_done=0.75))
    assert state.seconds_left == pytest.approx(20.0)  # by the files alone it would be 240


def test_plain_lines_are_rate_limited():
    lines = []
    show = EventLines(lines.append, interval_seconds=0.2)
    show(PhaseStarted("load", 100))
    begun = time.monotonic()
    for step in (7, 8, 9):
        while time.monotonic() < begun + 0.25 * (step - 6):
            show(PhaseProgress("load", step, 100))
    assert [line.partition(",")[0] for line in lines[1:]] == ["  7/100", "  8/100", "  9/100"]


def test_plain_lines_are_not_repeated():
    lines = []
    show = EventLines(lines.append, interval_seconds=0.0)
    for event in (PhaseStarted("export", 5), *3 * [PhaseProgress("export", 0, 5)]):
        show(event)
    assert lines == ["Exporting", "  0/5"]


def test_warnings_go_to_stderr(capsys):
    with show_progress(quiet=True) as show:
        show(Warned("The sky is green."))
    assert capsys.readouterr().err == "Warning: The sky is green.\n"


@pytest.fixture
def terminal():
    """A terminal of 80 columns and what was written to it."""
    written = io.StringIO()
    return Console(file=written, force_terminal=True, width=80, _environ={}), written


def test_bar_fits_a_narrow_terminal_and_shows_everything(terminal):
    console, written = terminal
    display = ProgressBars(console, lambda: False)
    with display.bars:
        for event in (PhaseStarted("train", 1500), HELD_OUT, TRAINING):
            display(event)
        display.bars.refresh()
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", written.getvalue())
    assert "310/1500" in text and "1:23 left" in text
    assert STATE in text
    assert max(map(len, re.split(r"[\r\n]+", text))) <= 80


def test_progress_bar_leaves_line_per_stage_and_shows_stop(terminal):
    console, written = terminal
    stop = []
    display = ProgressBars(console, lambda: bool(stop))
    with display.bars:
        for event in (PhaseStarted("load"), PhaseProgress("load", 4, 4), PhaseFinished("load", 0.25)):
            display(event)
        assert "Loaded 4 photographs in 0.2 s\n" in written.getvalue()
        display(Warned("[red]The sky is green."))
        assert "Warning: [red]The sky is green." in written.getvalue()
        assert "Stopping" not in written.getvalue()
        stop.append(1)
        display.bars.refresh()
    assert "Stopping" in written.getvalue()


def test_should_stop_between_steps_cancels():
    heard, stop = [], []
    listen = stop_when_asked(heard.append, lambda: bool(stop))
    listen(PhaseProgress("export", 1, 3))
    stop.append(1)
    listen(TRAINING)  # training writes a checkpoint and stops by itself
    with pytest.raises(CancelledError, match="exporting"):
        listen(PhaseProgress("export", 2, 3))
    assert len(heard) == 3


def test_should_stop_between_stages_cancels():
    heard = []
    listen = stop_when_asked(heard.append, lambda: True)
    listen(PhaseFinished("read", 0.5))
    with pytest.raises(CancelledError, match="rendering"):
        listen(PhaseStarted("render"))


@pytest.mark.parametrize(
    ("shown", "expected"),
    [
        (format_clock(83.2), "1:23"),
        (format_clock(3723), "1:02:03"),
        (format_clock(-0.3), "0:00"),
        (format_duration(0.84), "0.8 s"),
        (format_duration(42.3), "42 s"),
        (format_duration(59.7), "1:00 min"),
        (format_duration(185), "3:05 min"),
        (format_duration(3723), "1:02:03 h"),
        (format_rate(870), "870"),
        (format_rate(310_400), "310k"),
        (format_rate(1_254_000), "1.25M"),
    ],
)
def test_rate_is_formatted_with_suffix(shown, expected):
    assert shown == expected


@pytest.mark.parametrize(
    "event",
    [
        PhaseStarted("train", 5),
        PhaseProgress("render", 1, 3, 0.5),
        TRAINING,
        CheckpointWritten(100, "a.npz"),
        ImagesSaved(4),
        Warned("a"),
        RunFinished(("scene.ply", "report.json"), 12.5),
    ],
)
def test_written_events_are_read_back(event):
    content = json.loads(json.dumps(event.as_dict()))
    assert parse_event(content.pop("kind"), content) == event
