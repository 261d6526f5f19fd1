"""Runs measured by request: figures as typed values, smaller sizes, all views, another background."""

import json
import shutil
from pathlib import Path

import pytest

from octasplat.engine.core.errors import CancelledError, ConfigError
from octasplat.engine.core.events import PhaseFinished
from octasplat.engine.operations.base import build_request
from octasplat.engine.operations.evaluate import OPERATION, EvaluateRequest
from octasplat.workers.worker.handlers import run_operation
from octasplat.workers.worker.job_kinds import get_job_kind
from octasplat.workers.worker.task import Task


@pytest.fixture
def copy(run, tmp_path) -> Path:
    """The run of the other tests, to be measured anew."""
    return shutil.copytree(run.output, tmp_path / "run", ignore=shutil.ignore_patterns("on", "cache"))


def test_evaluate_result_equals_metrics_file(copy):
    heard = []
    result = OPERATION.run(EvaluateRequest(source=copy), progress=heard.append, threads=1)
    metrics = json.loads((copy / "metrics.json").read_text())
    assert result.psnr == metrics["mean"]["psnr"] > 10
    assert result.ssim == metrics["mean"]["ssim"] and result.flip == metrics["mean"]["flip"]
    assert result.views == metrics["views"] and len(result.views) == 2
    assert result.files[0] == copy / "metrics.json" and result.report == copy / "report.html"
    assert {path.name for path in result.files} >= {f"{Path(name).stem}.png" for name in result.views}
    assert any(f"PSNR {result.psnr:.2f} dB" in line for line in result.lines())
    assert [event.stage for event in heard if isinstance(event, PhaseFinished)] == ["evaluate"]


def test_smaller_sizes_are_the_same_by_command_and_job(copy, run, octasplat, tmp_path):
    done = octasplat("evaluate", copy, "--dataset", run.scene, "--scales", "4,2,2", "--threads", 1)
    assert done.exit_code == 0, done.output
    found = json.loads((copy / "scales.json").read_text())
    assert list(found) == ["1/2", "1/4"] and f"{found['1/2']['4']:.2f} dB with 4" in done.output
    shutil.copytree(run.output, tmp_path / "attempt" / "run", ignore=shutil.ignore_patterns("on", "cache"))
    kind = get_job_kind("evaluate")
    options = kind.resolve({"scales": [2, 4]}).model_dump(mode="json")
    assert options == {"all_views": False, "scales": [2, 4]}
    run_operation(Task(tmp_path / "attempt", options, scene=run.scene, threads=1, kind="evaluate"))
    results = tmp_path / "attempt" / "results"
    assert [path.name for path in results.iterdir()] == ["scales.json"]
    assert (results / "scales.json").read_bytes() == (copy / "scales.json").read_bytes()


def test_evaluate_all_views_with_other_background(copy, run, octasplat):
    before = (copy / "metrics.json").read_bytes()
    done = octasplat("evaluate", copy, "--all-views", "--evaluation-background", "white", "--threads", 1)
    assert done.exit_code == 0, done.output
    metrics = json.loads((copy / "on" / run.scene.name / "metrics.json").read_text())
    assert len(metrics["views"]) == 8 and metrics["background"] == "white"
    page = (copy / "on" / run.scene.name / "report.html").read_text()
    assert "8 views" in page and "8 held-out" not in page
    assert "Mean over 8" in done.output and (copy / "metrics.json").read_bytes() == before


def test_evaluate_should_stop_cancels(copy):
    with pytest.raises(CancelledError, match="Stopped while evaluating"):
        OPERATION.run(EvaluateRequest(source=copy), should_stop=lambda: True, threads=1)


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"scales": "2,none"}, "scales: scales are whole numbers from 1 on"),
        ({"scales": [0, 2]}, "scales: scales are whole numbers from 1 on"),
        ({"scales": "2", "other_dataset": "a"}, "leave out other_dataset"),
        ({"scales": "2", "all_views": True}, "leave out all_views"),
        ({"other_dataset": "a", "dataset": "b"}, "choose one of dataset"),
    ],
)
def test_evaluate_contradictory_options_are_refused(values, told):
    with pytest.raises(ConfigError, match=told):
        build_request(EvaluateRequest, {"source": "run", **values})
