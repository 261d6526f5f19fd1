"""``reconstruct``: photographs to a scene, its meshes and measurements."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import BeforeValidator, Field, ValidationError, field_validator

from octasplat.engine.core.events import EventListener, ignore_events
from octasplat.engine.operations.base import Operation, Options, Output, Request, Result, never_stop
from octasplat.engine.operations.block_options import BlockOptions, block_request
from octasplat.engine.operations.photograph_sizes import photograph_sizes
from octasplat.engine.runs.run_settings import RunSettings
from octasplat.engine.settings import renamed_settings
from octasplat.engine.settings.fields import (
    ADVANCED,
    BASIC,
    PartialOf,
    Positional,
    ReadPath,
    Shortcut,
    Spelling,
    Unit,
)
from octasplat.engine.settings.nested_options import merge_options, split_dotted_names
from octasplat.engine.settings.refusals import InvalidSettingsError, refusals_from

if TYPE_CHECKING:
    from octasplat.engine.pipeline import OnStep
    from octasplat.engine.runs.config import ReconstructionConfig

_CONFIG, _METRICS, _REPORT, _SCENE = "config.json", "metrics.json", "report.html", "scene.ply"


def _read_settings(value: object) -> object:
    """Return settings by name as texts such as ``lr.quat=0.02``; one text alone as the only one."""
    if isinstance(value, str):
        return (value,)
    if isinstance(value, Mapping):
        return tuple(f"{name}={json.dumps(setting, default=_as_json)}" for name, setting in value.items())
    return value


def _as_json(value: Any) -> Any:
    """Return what JSON has for a value of Python: numbers of an array, or the text of a path."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


class PlainReconstructOptions(RunSettings, Options):
    """Options of a reconstruction as a whole: a preset, and settings that differ from it."""

    former_names: ClassVar[renamed_settings.FormerNames] = renamed_settings.RECONSTRUCT

    materials: Annotated[bool, BASIC] = Field(
        False,
        description="Learn materials and the environment of shiny things; environment.hdr lies beside the "
        "scene then.",
    )
    for_surface: Annotated[bool, BASIC] = Field(
        False,
        description="Hold normals and depths together, so that a surface made of the scene is smoother.",
    )
    iterations: Annotated[int | None, Shortcut("iterations"), Spelling(metavar="N")] = Field(
        None, description="Iterations of the training; 0 asks the photographs' pixels."
    )
    rays_per_batch: Annotated[int | None, Shortcut("rays_per_batch"), Spelling(metavar="N")] = Field(
        None, description="Rays of one iteration."
    )
    max_gaussians: Annotated[int | None, Shortcut("max_gaussians"), Spelling(metavar="N")] = Field(
        None, description="Most Gaussians; 0, the default, asks the photographs' pixels."
    )
    sh_degree: Annotated[int | None, Shortcut("sh_degree"), Spelling(metavar="N")] = Field(
        None, description="Degree of the spherical harmonics of the colors, 0 to 3."
    )
    seed: Annotated[int | None, Shortcut("seed"), Spelling(metavar="N")] = Field(
        None, description="Seed of everything random.  [default: 0]"
    )
    train: Annotated[
        dict[str, Any], PartialOf("octasplat.engine.train.config:TrainConfig"), Spelling(hidden=True)
    ] = Field(
        default_factory=dict,
        description="Settings of the training that are to be otherwise than the preset's, by names or in "
        "sections.",
    )
    set: Annotated[
        tuple[str, ...],
        BeforeValidator(_read_settings, json_schema_input_type=tuple[str, ...] | dict[str, Any] | str),
        Spelling(metavar="NAME=VALUE", repeated=True),
        ADVANCED,
    ] = Field(
        (),
        max_length=1000,
        description="Any other setting, e.g. lr.quat=0.02 or test_every=4, values as JSON; octasplat "
        "config list shows them.",
    )

    @field_validator("train")
    @classmethod
    def _in_sections(cls, train: dict[str, Any]) -> dict[str, Any]:
        """Take names with dots, such as ``lr.quat``, as those of sections."""
        return split_dotted_names(train)

    def config(self) -> "ReconstructionConfig":
        """Return the complete configuration that the options mean.

        Raises:
            InvalidSettingsError: a setting is unknown, out of range or contradicts another.
        """
        from octasplat.engine.runs.config import resolve_config

        settings = {name: getattr(self, name) for name in RunSettings.model_fields if name != "preset"}
        return resolve_config(
            self.preset,
            materials=self.materials,
            settings=settings,
            train=self._nested_train_settings(),
            assignments=self.set,
        )

    def requested(self) -> dict[str, Any]:
        """Return the given settings as JSON, those of the training by their places below ``train``.

        No defaults and no settings of the preset are among them, so that each version resolves them itself.
        """
        from octasplat.engine.runs.config import requested_settings

        given = self.model_dump(mode="json", include=RunSettings.model_fields.keys() & self.model_fields_set)
        requested = requested_settings(
            given,
            materials=self.materials if "materials" in self.model_fields_set else None,
            train=merge_options(self.train, self._shortcut_settings()),
            assignments=self.set,
        )
        return {**requested, "for_surface": True} if self.for_surface else requested

    def given(self) -> tuple[str, ...]:
        """Return the names, with dots, of the settings that the options give, whatever their values.

        Raises:
            InvalidSettingsError: a setting is unknown.
        """
        from octasplat.engine.runs.config import given_settings

        return given_settings(
            {name: getattr(self, name) for name in RunSettings.model_fields if name in self.model_fields_set},
            materials=self.materials if "materials" in self.model_fields_set else None,
            train=self._nested_train_settings(),
            assignments=self.set,
        )

    def revised(self, before: Mapping[str, Any]) -> "ReconstructionConfig":
        """Return a complete configuration, given as JSON, overridden by the options that were given.

        Raises:
            InvalidSettingsError: a setting is unknown, out of range or contradicts another.
        """
        from octasplat.engine.runs.config import revise_config

        given = self.model_fields_set
        return revise_config(
            before,
            materials=self.materials if "materials" in given else None,
            settings={name: getattr(self, name) for name in RunSettings.model_fields if name in given},
            train=self._nested_train_settings(),
            assignments=self.set,
        )

    def _nested_train_settings(self) -> dict[str, Any]:
        """Return the training's settings that the options name, nested."""
        from octasplat.engine.train.config import SURFACE_DEPTH_NORMAL_WEIGHT

        shortcuts = self._shortcut_settings()
        if self.for_surface:
            shortcuts["loss"] = {"depth_normal": SURFACE_DEPTH_NORMAL_WEIGHT}
        return merge_options(self.train, shortcuts)

    def _shortcut_settings(self) -> dict[str, Any]:
        """Return the training's settings that options beside ``train`` name."""
        names = {name: info.metadata for name, info in PlainReconstructOptions.model_fields.items()}
        return {
            mark.setting: getattr(self, name)
            for name, marks in names.items()
            for mark in marks
            if isinstance(mark, Shortcut) and getattr(self, name) is not None
        }


class ReconstructOptions(PlainReconstructOptions, BlockOptions):
    """Options of a reconstruction: a preset, settings that differ from it, and blocks if there are any."""


class ReconstructRequest(ReconstructOptions, Request):
    """Reconstruct PHOTOS, a folder with images/ and a COLMAP model in sparse/0, or with photographs alone.

    Where there is no model, COLMAP finds the poses of the photographs. PHOTOS may also be a video: its
    sharpest frames become photographs, in a folder beside the output. The output folder gets scene.ply,
    meshes, metrics.json, report.html, renders of the held-out views and checkpoints. Ctrl-C stops after
    writing a checkpoint; the same command with --resume goes on.
    """

    source: Annotated[Path, Positional("PHOTOS"), ReadPath()] = Field(
        description="The folder of the photographs, or a video."
    )
    output: Output = Field(description="Folder for the results.")
    fps: Annotated[float, Unit("images/s"), Spelling(metavar="N")] = Field(
        2.0,
        gt=0,
        le=120,
        description="Of a video: so many frames of each second are taken, the sharpest ones.",
    )
    start_from: Annotated[Path | None, ReadPath(), Spelling(metavar="RUN")] = Field(
        None,
        description="Begin with the Gaussians of that run, finished or stopped, or of a file of Gaussians, "
        "instead of the sparse points; poses that the run found are taken, too.",
    )
    resume: bool = Field(
        False,
        description="Go on with the run in the output folder, if there is one; without other options its own "
        "settings are taken.",
    )


class ReconstructResult(Result):
    """A finished run.

    Attributes:
        metrics: what was measured, as ``metrics.json`` holds it.
        scene: the Gaussians.
        report: the page that shows what was measured.
        summary: sentences about the run.
    """

    metrics: Mapping[str, Any] = {}
    scene: Path
    report: Path
    summary: tuple[str, ...] = ()

    @property
    def config(self) -> "ReconstructionConfig":
        """Return all settings of the run."""
        from octasplat.engine.runs.config import read_config

        assert self.folder is not None
        return read_config(self.folder / _CONFIG)

    @property
    def psnr(self) -> float | None:
        """Return the mean PSNR of the held-out views in dB; None where there are none."""
        value = self.metrics.get("mean", {}).get("psnr")
        return None if value is None else float(value)

    def lines(self) -> tuple[str, ...]:
        """Return the PSNR and the report's place in sentences."""
        return self.summary


def options_from_json(requested: Mapping[str, Any]) -> ReconstructOptions:
    """Return the options of a queued reconstruction from JSON.

    Raises:
        InvalidSettingsError: an option is unknown or out of range.
    """
    try:
        return ReconstructOptions.model_validate(dict(requested))
    except ValidationError as error:
        raise InvalidSettingsError(refusals_from(error, ReconstructOptions)) from None


def run_config(request: ReconstructRequest) -> "ReconstructionConfig":
    """Return the configuration of a run: that of the request or, to resume without options, the run's own.

    Raises:
        ConfigError: a setting cannot be used, or the run's settings cannot be read.
    """
    from octasplat.engine.runs.config import read_config

    if not _takes_own_settings(request):
        return request.config()
    config = read_config(request.output / _CONFIG)
    if "exports" in request.model_fields_set:
        config = config.model_copy(update={"exports": request.exports})
    return config


def _takes_own_settings(request: ReconstructRequest) -> bool:
    """Return whether a request goes on with a run by the run's own settings."""
    # with options the request's configuration counts, and is checked against the run's
    given = request.model_fields_set - {
        *("source", "output", "resume", "exports", "fps", "blocks", "memory", "start_from")
    }  # fmt: skip
    # empty ones say nothing, whoever filled them in
    given -= {name for name in ("train", "set") if not getattr(request, name)}
    return request.resume and not given and (request.output / _CONFIG).exists()


def scene_folder(request: ReconstructRequest) -> Path:
    """Return the folder of the photographs; that of a video's frames is beside the output."""
    from octasplat.engine.dataset.video_frames import is_video

    source, output = request.source, request.output
    if output.name in ("", ".."):  # as of ".", which has no name of its own
        output = output.resolve()
    return output.with_name(f"{output.name}-frames") if is_video(source) else source


def _take_frames(request: ReconstructRequest, folder: Path, progress: EventListener) -> None:
    """Write the sharpest frames of the request's video, and tell where they are.

    Raises:
        DatasetError: the video cannot be read.
        OutputError: the folder of the frames cannot be written.
    """
    from octasplat.engine.core.events import Noted
    from octasplat.engine.core.progress import counted_phase
    from octasplat.engine.dataset.video_frames import write_frames

    with counted_phase("frames", progress) as count:
        written = write_frames(request.source, folder, request.fps, count)
    progress(Noted(f"{written} frames of {request.source.name} are in {folder}."))


def run(
    request: ReconstructRequest,
    *,
    progress: EventListener = ignore_events,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
    on_step: "OnStep | None" = None,
) -> ReconstructResult:
    """Reconstruct a scene; see :class:`octasplat.engine.operations.base.Run`.

    Args:
        request: what to do.
        progress: called with each event.
        should_stop: asked now and then; True stops the run after a checkpoint.
        threads: number of threads; 0 means all cores.
        on_step: called with the training after each iteration; it must change nothing.

    Raises:
        OctasplatError: as :func:`octasplat.engine.pipeline.reconstruction` does.
    """
    from octasplat.engine.core.progress import stop_when_asked
    from octasplat.engine.pipeline import reconstruct
    from octasplat.engine.poses.photographs import locate_scene

    config = run_config(request)
    output = request.output
    scene = scene_folder(request)
    if scene != request.source:  # the source is a video
        _take_frames(request, scene, stop_when_asked(progress, should_stop))
    located, blocks = locate_scene(scene), None
    if request.blocks is not None or request.memory is not None:
        sizes = photograph_sizes(located) if request.memory is not None else []
        blocks = block_request(request, config, sizes)
    reconstruct(
        located,
        output,
        config,
        resume=request.resume,
        threads=threads,
        progress=stop_when_asked(progress, should_stop),
        should_stop=should_stop,
        on_step=on_step,
        blocks=blocks,
        start_from=request.start_from,
        given=None if _takes_own_settings(request) else request.given(),
    )
    return finished_result(output, config.exports)


def finished_result(output: Path, exports: Sequence[str]) -> ReconstructResult:
    """Return the result of the finished run in a folder, whose files of these names were asked for."""
    from octasplat.engine.evaluate.summary import summarize_run

    return ReconstructResult(
        files=tuple(output / name for name in (_SCENE, *exports, _METRICS, _REPORT)),
        folder=output,
        metrics=json.loads((output / _METRICS).read_text(encoding="utf-8")),
        scene=output / _SCENE,
        report=output / _REPORT,
        summary=tuple(summarize_run(output, exports)),
    )


OPERATION = Operation(
    "reconstruct",
    "Photographs to a scene, its meshes, and measurements.",
    ReconstructRequest,
    ReconstructOptions,
    run,
)
