"""Short text summary of the evaluation of a run."""

import json
import shlex
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from octasplat.engine.core.durations import format_duration
from octasplat.engine.core.georeference import Georeference
from octasplat.engine.poses.found_models import describe_other_models
from octasplat.engine.runs.result_files import file_label
from octasplat.engine.runs.run_folder import POSES

_METRICS = (
    ("psnr", "PSNR {:.2f} dB"),
    ("ssim", "SSIM {:.3f}"),
    ("ms_ssim", "MS-SSIM {:.3f}"),
    ("flip", "FLIP {:.3f}"),
    ("psnr_foreground", "PSNR of the foreground {:.2f} dB"),
)

_TRUTH = (
    ("normal_mae", "normals {:.2f} degrees off"),
    ("albedo_psnr_scaled", "albedo {:.2f} dB (one scale)"),
    ("roughness_mae", "roughness {:.3f} off"),
    ("metallic_mae", "metallic {:.3f} off"),
    ("environment_psnr_scaled", "environment {:.2f} dB (one scale)"),
    ("relight_psnr", "relit {:.2f} dB"),
    ("relight_psnr_scaled", "{:.2f} dB with one scale"),
)


def format_mean_metrics(metrics: dict[str, Any], noun: str = "held-out view") -> str:
    """Return a line on the views from the content of ``metrics.json``; ``noun`` is what each of them is."""
    count = len(metrics["views"])
    if count == 0:
        return "No views were held out, so nothing was measured."
    mean = metrics["mean"]
    known = [form.format(mean[key]) for key, form in _METRICS if mean.get(key) is not None]
    left_out = metrics.get("mean_left_out", {}).get("psnr", 0)
    without = f" ({left_out} perfect or wholly masked left out)" if left_out else ""
    return f"Mean over {count} {noun}{'s' if count > 1 else ''}{without}: {', '.join(known)}"


def summarize_evaluation(path: Path) -> list[str]:
    """Return lines on what was measured on other photographs into ``path``, and where it is shown."""
    metrics: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    known = metrics.get("truth", {}).get("mean", {})
    truth_figures = [form.format(known[key]) for key, form in _TRUTH if known.get(key) is not None]
    return [
        format_mean_metrics(metrics, "view"),  # which may have been trained on
        *([f"Against the truth: {', '.join(truth_figures)}"] if truth_figures else []),
        f"{'Report:':8}{path.with_name('report.html')}",
    ]


def summarize_run(output: Path, exports: Iterable[str]) -> list[str]:
    """Return lines on what a finished run in ``output`` reached and where its files are."""
    metrics: dict[str, Any] = json.loads((output / "metrics.json").read_text(encoding="utf-8"))
    files = [
        ("Report", "report.html"),
        ("Scene", "scene.ply"),
        *((file_label(name), name) for name in exports),
    ]
    poses = metrics.get("poses", {})
    placed, moved = poses.get("placed"), len(poses.get("moved", ()))
    return [
        *([f"Poses found for {placed} of {poses['photographs']} photographs"] if placed else []),
        *([sentence] if (sentence := describe_other_models(output / POSES)) is not None else []),
        *([f"Placed {moved} photograph{'s' if moved > 1 else ''} anew"] if moved else []),
        *(["Adjusted the lens of each photograph"] if poses.get("lenses") else []),
        format_mean_metrics(metrics),
        *_training_views(metrics.get("training_views") or {}),
        f"{metrics['gaussians']:,} Gaussians after {metrics['iterations']:,} iterations, "
        f"trained in {format_duration(metrics['seconds'])}",
        *_place(metrics),
        *metrics.get("advice", ())[:1],
        *(f"{label + ':':10}{output / name}" for label, name in files if (output / name).exists()),
        f"{'In 3D:':10}octasplat view {shlex.quote(str(output))}",
    ]


def _place(metrics: dict[str, Any]) -> list[str]:
    """Return a line on the georeference."""
    known = metrics.get("georeference")
    return [] if known is None else ["; ".join(Georeference.model_validate(known).facts())]


def _training_views(known: dict[str, Any]) -> list[str]:
    """Return a line on how well the views that were trained on are shown."""
    if known.get("psnr") is None:
        return []
    count, left = len(known["views"]), len(known["left_out"])
    without = f", {left} left out" if left else ""
    return [
        f"Mean over {count} training views: PSNR {known['psnr']:.2f} dB, "
        f"{known['worst_psnr']:.2f} dB the worst ({known['worst']}){without}"
    ]
