"""Runs: reconstructions in folders, begun, stopped, gone on with, and looked at."""

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from octasplat.engine.core.errors import CancelledError, ConfigError
from octasplat.engine.core.events import (
    Event,
    EventListener,
    PhaseProgress,
    TrainingProgress,
    parse_event,
    read_events,
)
from octasplat.notebook import default_progress, table_html
from octasplat.operation_calls import explicit_values, run_operation
from octasplat.paths import PathLike
from octasplat.scenes import Scene, load

if TYPE_CHECKING:
    from octasplat.engine.render.pinhole_camera import PinholeCamera

_CONFIG, _EDITS, _EVENTS, _METRICS, _REPORT, _SCENE, _TRAINING = (
    "config.json", "edits.json", "events.jsonl", "metrics.json", "report.html", "scene.ply", "training.json",
)  # fmt: skip
OnStep = Callable[[TrainingProgress], bool | None]
"""Called with the state of the training every few iterations; returning False stops it.

While residual colors are fitted, it is called with the last state and the time that this still takes.
"""


def reconstruct_run(
    values: Mapping[str, Any],
    on_step: OnStep | None,
    progress: EventListener | None,
    should_stop: Callable[[], bool],
    threads: int,
) -> "Run":
    """Do the request of a reconstruction; where ``on_step`` returns False, return the unfinished run.

    Raises:
        CancelledError: ``should_stop`` returned True.
        OctasplatError: as the operation does.
    """
    from octasplat.engine.operations.reconstruct import (
        ReconstructOptions,
        ReconstructRequest,
        options_from_json,
    )

    given = explicit_values(ReconstructRequest, values)
    # Refused here, so that the sentence is that of a setting wherever it is given.
    options_from_json(
        {name: value for name, value in given.items() if name in ReconstructOptions.model_fields}
    )
    stopped = False
    trained: TrainingProgress | None = None
    listener = progress or default_progress()

    def listen(event: Event) -> None:
        nonlocal stopped, trained
        listener(event)
        if isinstance(event, TrainingProgress):
            trained = event
        elif isinstance(event, PhaseProgress) and event.stage == "residual":
            trained = trained or _last_of_training(Path(values["output"]))
            if trained is not None:
                left = (1 - event.step / event.total_steps) * trained.seconds_after
                event = replace(trained, seconds_left=left, seconds_after=left)
        if on_step is not None and isinstance(event, TrainingProgress) and on_step(event) is False:
            # It ends at the next safe point, where should_stop is asked.
            stopped = True

    try:
        run_operation("reconstruct", values, listen, lambda: stopped or should_stop(), threads)
    except CancelledError:
        # Where on_step has stopped it, the run goes on later and nothing has failed.
        if not stopped:
            raise
    return Run(values["output"])


def _last_of_training(output: Path) -> TrainingProgress | None:
    """Return the last state of its training that a run has told; None where it has told none."""
    for row in reversed(read_events(output / _EVENTS)):
        if row.get("kind") == TrainingProgress.kind:
            event = parse_event(TrainingProgress.kind, row)
            return event if isinstance(event, TrainingProgress) else None
    return None


class Run:
    """A reconstruction in a folder, finished or not; wherever a path is asked for, it stands for its folder.

    >>> import octasplat as osp
    >>> run = osp.Run("run")
    >>> run.is_finished, run.psnr > 10, run.report.name
    (True, True, 'report.html')
    >>> len(run.scene) > 100, run.scene.sh_degree
    (True, 0)
    >>> sorted(run.views)
    ['view_000.png', 'view_008.png']
    """

    def __init__(self, folder: PathLike) -> None:
        """Open a folder.

        Raises:
            ConfigError: it is not that of a run.
        """
        self.path = Path(folder)
        if not (self.path / _CONFIG).is_file():
            raise ConfigError(f"{self.path} holds no {_CONFIG}; name the folder of a run.")

    def __fspath__(self) -> str:
        return str(self.path)

    @property
    def is_finished(self) -> bool:
        """Return whether the scene is there as it is to be; if not, :func:`reconstruct` resumes the run.

        That is a scene that was trained and evaluated, or one that an edit has made of it, which
        :func:`evaluate` measures.
        """
        is_done = (self.path / _METRICS).exists() or (self.path / _EDITS).exists()
        return is_done and (self.path / _SCENE).exists()

    @property
    def metrics(self) -> Mapping[str, Any]:
        """Return the metrics as ``metrics.json`` holds them; empty before the evaluation."""
        return _read_json(self.path / _METRICS)

    @property
    def psnr(self) -> float | None:
        """Return the mean PSNR of the held-out views in dB; None before the evaluation."""
        value = self.metrics.get("mean", {}).get("psnr")
        return None if value is None else float(value)

    @property
    def views(self) -> Mapping[str, Mapping[str, float]]:
        """Return the metrics of each held-out view, by the name of its photograph."""
        found: Mapping[str, Mapping[str, float]] = self.metrics.get("views", {})
        return found

    @property
    def cameras(self) -> Mapping[str, "PinholeCamera"]:
        """Return where each photograph was taken from, by its name, held out or not.

        With such a camera :func:`octasplat.render` shows the run's scene as in the photograph. Lenses with
        distortion are replaced by pinholes that show what lies between the middles of the image's sides, a
        panorama by one that looks ahead.

        Raises:
            OctasplatError: the run keeps no cameras, as runs of old, and its photographs cannot be read.

        >>> import octasplat as osp
        >>> run = osp.Run("run")
        >>> camera = run.cameras["view_000.png"]
        >>> osp.render(run.scene, camera).rgb.shape == (camera.height_px, camera.width_px, 3)
        True
        """
        from octasplat.engine.runs.run_folder import run_min_view_distance, run_viewpoints
        from octasplat.engine.surface.depth_cameras import photograph_cameras

        found = run_viewpoints(self.path)
        near = run_min_view_distance(self.path, found)
        sizes = [max(view.width_px, view.height_px) for view in found.views]
        return {
            # Of a panorama, which has six, the one ahead.
            view.name: photograph_cameras(found, np.array([index]), size, near)[0]
            for index, (view, size) in enumerate(zip(found.views, sizes, strict=True))
        }

    @property
    def settings(self) -> Mapping[str, Any]:
        """Return all settings of the run by their present names."""
        from octasplat.engine.runs.config import ReconstructionConfig
        from octasplat.engine.settings.renamed_settings import replace_former_names

        path = self.path / _CONFIG
        found: Mapping[str, Any] = _read_json(path).get("reconstruction", {})
        return replace_former_names((ReconstructionConfig,), found, source=str(path))

    @property
    def training(self) -> Mapping[str, Any]:
        """Return facts about the training, such as ``seconds`` and ``iterations``; empty before its end."""
        return _read_json(self.path / _TRAINING)

    @property
    def report(self) -> Path:
        """Return the path of the report page."""
        return self.path / _REPORT

    @cached_property
    def scene(self) -> Scene:
        """Return the scene, read when it is first used."""
        return load(self.path)

    def __repr__(self) -> str:
        state = "unfinished" if not self.is_finished else _psnr_text(self.psnr)
        return f"Run({str(self.path)!r}, {state})"

    def _repr_html_(self) -> str:
        rows: dict[str, object] = {"state": "finished" if self.is_finished else "unfinished"}
        mean = self.metrics.get("mean", {})
        rows |= {name: f"{value:.4g}" for name, value in mean.items() if isinstance(value, int | float)}
        if "seconds" in self.training:
            rows["training"] = f"{self.training['seconds']:.0f} s"
        if self.report.exists():
            rows["report"] = self.report
        return table_html(f"Run {self.path}", rows)


def _psnr_text(psnr: float | None) -> str:
    return "not measured" if psnr is None else f"PSNR {psnr:.2f} dB"


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    return content
