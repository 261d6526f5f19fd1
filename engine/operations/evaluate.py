"""``evaluate``: measure a finished run again, or on other photographs."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field, model_validator

from octasplat.engine.core.events import EventListener, ignore_events
from octasplat.engine.operations.base import Operation, Options, Request, Result, never_stop
from octasplat.engine.settings import renamed_settings
from octasplat.engine.settings.fields import DatasetFolder, Positional, ReadPath, Spelling

_METRICS, _REPORT, _PICTURES = "metrics.json", "report.html", ("renders", "layers")


def _read_scales(value: object) -> object:
    """Return the numbers of a text such as ``2,4,8``, or of several, in order and each once."""
    parts = value.split(",") if isinstance(value, str) else (value,) if isinstance(value, int) else value
    if not isinstance(parts, list | tuple | set):
        return value
    try:
        numbers = sorted({int(part) for part in parts})
    except (TypeError, ValueError):  # refused below, with the sentence about scales
        numbers = [0]
    if numbers and numbers[0] < 1:
        raise ValueError("scales are whole numbers from 1 on, such as 2,4,8")
    return tuple(numbers)


class EvaluateOptions(Options):
    """Options of which views of a finished reconstruction are evaluated, and how."""

    former_names: ClassVar[renamed_settings.FormerNames] = renamed_settings.EVALUATE

    all_views: bool = Field(
        False,
        description="Measure all photographs, not only those that were held out, into on/<name of their "
        "folder>; so it is with photographs of another dataset, which a job names as 'dataset_id'.",
    )
    scales: Annotated[
        tuple[int, ...],
        Spelling(metavar="N,N..."),
        BeforeValidator(_read_scales, json_schema_input_type=tuple[int, ...] | str),
    ] = Field(
        (),
        max_length=20,
        exclude_if=lambda scales: not scales,
        description="Measure smaller sizes instead, such as 2,4,8: renders at 1/2, 1/4 and 1/8 of the size "
        "against photographs made as small, with 1, 4 and 16 rays per pixel; into scales.json.",
    )
    evaluation_background: Literal["black", "white"] | None = Field(
        None,
        exclude_if=lambda background: background is None,
        description="Color behind the scene and behind what masks leave out.  [default: the run's]",
    )

    @model_validator(mode="after")
    def _one_kind(self) -> "EvaluateOptions":
        if self.scales and self.all_views:
            raise ValueError("scales are measured on the views that were held out; leave out all_views")
        return self


class EvaluateRequest(EvaluateOptions, Request):
    """Measure the run in the folder OUT again: metrics.json, report.html and renders/ are written anew."""

    source: Annotated[Path, Positional("OUT"), ReadPath()] = Field(
        description="The folder of a finished run."
    )
    dataset: DatasetFolder = Field(
        None,
        description="Where the run's photographs are now, if they were moved or the run was downloaded.",
    )
    other_dataset: Annotated[Path | None, Spelling(metavar="FOLDER"), ReadPath()] = Field(
        None,
        description="Measure all photographs of another folder instead (images/ and sparse/0 in the same "
        "world as the run's); the results go to OUT/on/<its name>.",
    )

    @model_validator(mode="after")
    def _one_folder(self) -> "EvaluateRequest":
        if self.other_dataset is not None and self.dataset is not None:
            raise ValueError("choose one of dataset (the run's own photographs) and other_dataset")
        if self.other_dataset is not None and self.scales:
            raise ValueError("scales are measured on the run's own photographs; leave out other_dataset")
        return self


class EvaluateResult(Result):
    """Metrics of the measured views.

    Attributes:
        metrics: all figures by name, as ``metrics.json`` holds them; empty where ``scales`` were measured.
        scales: mean PSNR in dB, by scale and by number of rays per pixel; empty where views were measured.
        report: the page that shows them.
        summary: sentences about them.
    """

    metrics: Mapping[str, Any] = {}
    scales: Mapping[str, Mapping[str, float]] = {}
    report: Path | None = None
    summary: tuple[str, ...] = ()

    @property
    def psnr(self) -> float | None:
        """Return the mean PSNR of the views in dB; None if there were none."""
        return self._mean_metric("psnr")

    @property
    def ssim(self) -> float | None:
        """Return the mean structural similarity of the views."""
        return self._mean_metric("ssim")

    @property
    def ms_ssim(self) -> float | None:
        """Return the mean multi-scale structural similarity; None for images too small for it."""
        return self._mean_metric("ms_ssim")

    @property
    def flip(self) -> float | None:
        """Return the mean perceived difference (FLIP); lower is better."""
        return self._mean_metric("flip")

    @property
    def views(self) -> Mapping[str, Mapping[str, float | None]]:
        """Return the metrics of each view, by the name of its photograph."""
        found: Mapping[str, Mapping[str, float | None]] = self.metrics.get("views", {})
        return found

    def lines(self) -> tuple[str, ...]:
        """Return the metrics and the report's place in sentences."""
        return self.summary

    def _mean_metric(self, name: str) -> float | None:
        value = self.metrics.get("mean", {}).get(name)
        return None if value is None else float(value)


def run(
    request: EvaluateRequest,
    *,
    progress: EventListener = ignore_events,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> EvaluateResult:
    """Measure a finished run; see :class:`octasplat.engine.operations.base.Run`.

    Raises:
        ConfigError: the source is no run.
        DatasetError: the photographs cannot be used.
        OutputError: there is no scene yet, or other photographs of that name were measured before.
    """
    from octasplat.engine.core.progress import stop_when_asked
    from octasplat.engine.evaluate import run_evaluation
    from octasplat.engine.evaluate.summary import summarize_evaluation, summarize_run
    from octasplat.engine.runs.run_folder import photographs_folder

    listener = stop_when_asked(progress, should_stop, "Stopped while evaluating.")
    if request.scales:
        return _measure_scales(request, listener, threads)
    on, dataset = request.other_dataset, request.dataset
    if request.all_views and on is None:
        # the run's own photographs, but all of them, as if of another dataset
        on, dataset = photographs_folder(request.source, dataset), None
    metrics = run_evaluation.evaluate(
        request.source,
        scene=dataset,
        on=on,
        background=request.evaluation_background,
        threads=threads,
        progress=listener,
    )
    folder = metrics.parent
    summary = (
        summarize_evaluation(metrics) if on is not None else summarize_run(folder, _exports_of_run(folder))
    )
    pictures = [path for name in _PICTURES for path in sorted((folder / name).rglob("*.png"))]
    return EvaluateResult(
        files=(metrics, folder / _REPORT, *pictures),
        folder=folder,
        metrics=json.loads(metrics.read_text(encoding="utf-8")),
        report=folder / _REPORT,
        summary=tuple(summary),
    )


def _measure_scales(request: EvaluateRequest, progress: EventListener, threads: int) -> EvaluateResult:
    from octasplat.engine.evaluate.run_evaluation import SCALES, evaluate_scales

    found = evaluate_scales(
        request.source,
        request.scales,
        scene=request.dataset,
        background=request.evaluation_background,
        threads=threads,
        listener=progress,
    )
    measures = {
        scale: ", ".join(f"{psnr:.2f} dB with {rays}" for rays, psnr in row.items())
        for scale, row in found.items()
    }
    return EvaluateResult(
        files=(request.source / SCALES,),
        folder=request.source,
        scales=found,
        summary=tuple(
            f"{scale} of the size: {figures} ray(s) a pixel" for scale, figures in measures.items()
        ),
    )


def _exports_of_run(run: Path) -> tuple[str, ...]:
    from octasplat.engine.runs.config import read_config
    from octasplat.engine.runs.run_folder import CONFIG

    return read_config(run / CONFIG).exports


OPERATION = Operation("evaluate", "Measure a finished run again.", EvaluateRequest, EvaluateOptions, run)
