"""``export``: Gaussians to meshes and other formats."""

import math
import os
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import AfterValidator, BeforeValidator, Field, FiniteFloat, model_validator

from octasplat.engine.core.errors import CancelledError, ExportError, SceneFileError
from octasplat.engine.core.events import EventListener, PhaseProgress, Warned, ignore_events
from octasplat.engine.files.export_options import ExportChoices, ExportOptions, OctagonQ
from octasplat.engine.files.registry import Exporter, exporter_for
from octasplat.engine.operations.axes import Axis
from octasplat.engine.operations.base import Operation, Options, Result, SourceRequest, never_stop, stop_if
from octasplat.engine.runs.export_names import ExportName
from octasplat.engine.settings import renamed_settings
from octasplat.engine.settings.fields import Group, Positional, Spelling

if TYPE_CHECKING:
    from octasplat.engine.gaussians.model import FlatGaussians
    from octasplat.engine.geometry.triangle_mesh import TriangleMesh


def read_direction(value: object) -> object:
    """Return the numbers of a text ``x,y,z``; any other value as it is."""
    if not isinstance(value, str) or value in ("cameras", "constant"):
        return value
    try:
        x, y, z = (float(part) for part in value.split(","))
    except ValueError:
        raise ValueError("write cameras, constant, or three numbers X,Y,Z") from None
    return x, y, z


def _several_paths(value: object) -> object:
    """Return a single path as a tuple of one; anything else as it is."""
    return (value,) if isinstance(value, str | os.PathLike) else value


_Color = Literal["cameras", "constant"] | tuple[FiniteFloat, FiniteFloat, FiniteFloat]


def _with_direction(color: _Color | None) -> _Color | None:
    if isinstance(color, tuple) and not math.hypot(*color) > 0:
        raise ValueError("is no direction")
    return color


class _ExportFields(ExportChoices, Options):
    """Options that export jobs and the export command share."""

    former_names: ClassVar[renamed_settings.FormerNames] = renamed_settings.EXPORT

    q: OctagonQ | None = Field(
        None,
        description="Meshes: squared radius of the octagons in standard deviations.  [default: that of the "
        "run, of a file 9.21]",
    )
    color: Annotated[
        _Color | None,
        BeforeValidator(read_direction, json_schema_input_type=_Color | str | None),
        AfterValidator(_with_direction),
        Spelling(metavar="cameras|constant|X,Y,Z"),
    ] = Field(
        None,
        description="Formats with one color for each Gaussian: the one that loses least seen from the "
        "photographs' places of a run, or from all around a file; the harmonics' constant part; or the one "
        "seen along a direction.  [default: cameras for a run, constant for a file]",
    )
    for_viewers: bool = Field(
        False,
        description="GLB: for programs that sort chunks at best, as viewer.glb is: solid middles beneath, "
        "and in a run whose photographs were taken from one side, the order that is right from most of "
        "them. Carries no numbers for edits.",
    )
    extent: Literal["photographed", "all"] = Field(
        "photographed",
        description="GLB for viewers: how much of a run is written, what lies in the space that the cameras "
        "surround, which viewers then frame, or all of it, with what is far behind.",
    )
    materials: bool = Field(
        False,
        description="GLB: base color, metallic and roughness instead of colors that have their light in "
        "them.",
    )
    up: Annotated[Axis | None, Group("advanced")] = Field(
        None, description="With materials: the axis that points up.  [default: the run's, of a file -y]"
    )

    @model_validator(mode="after")
    def _go_together(self) -> "_ExportFields":
        if self.up is not None and not self.materials:
            raise ValueError("`up` goes with `materials`")
        targets = self.targets()
        names = [_format_name(target, self.format_name()) for target in targets]
        message = f"{targets[-1]} is written as {names[-1]}"
        if None not in names and "glb" not in names:
            for name in ("opaque", "materials", "for_viewers"):
                if getattr(self, name):
                    raise ValueError(f"`{name}` is for GLB of octagons; {message}")
        if self.extent != "photographed" and not (self.for_viewers or {None, "viewer-glb"} & set(names)):
            raise ValueError(f"`extent` is for GLB for viewers; {message}")
        if self.for_viewers and (self.opaque or self.materials):
            raise ValueError("`for_viewers` is for GLB of octagons without `opaque` and `materials`")
        return self

    def targets(self) -> tuple[Path, ...]:
        """Return the files to write."""
        raise NotImplementedError

    def format_name(self) -> str | None:
        """Return the name of the format of all files, if their names do not say it."""
        return None


def _format_name(target: Path, requested: str | None) -> str | None:
    """Return the name of the format; None if there is none, which is reported later."""
    try:
        return exporter_for(target, requested).name
    except SceneFileError:
        return None


class ExportJobOptions(_ExportFields):
    """Options of which files to write, and how."""

    files: tuple[ExportName, ...] = Field(
        min_length=1, max_length=100, description="Files to write; their names say the formats."
    )

    def targets(self) -> tuple[Path, ...]:
        """Return the files to write."""
        return tuple(map(Path, self.files))


class ExportRequest(_ExportFields, SourceRequest):
    """Write the Gaussians of IN, a run's folder or a file of any splat format, to OUT in another format.

    OUT's name says the format, unless --format does; the formats are listed below. Where two take a name, as
    *.ply and *.mesh.ply do, the longer pattern wins.
    """

    files: Annotated[
        tuple[Path, ...],
        BeforeValidator(_several_paths, json_schema_input_type=tuple[Path, ...] | Path),
        Positional("OUT"),
    ] = Field(min_length=1, description="Files to write; their names say the formats.")
    format: Annotated[str | None, Spelling(metavar="NAME")] = Field(
        None, description="The format, if OUT's name does not say it."
    )

    def targets(self) -> tuple[Path, ...]:
        """Return the files to write."""
        return self.files

    def format_name(self) -> str | None:
        """Return the name of the format of all files, if their names do not say it."""
        return self.format


class ExportResult(Result):
    """Result of an export: the files that were written."""

    def lines(self) -> tuple[str, ...]:
        """Return the files with their sizes; those in folders beside a file are counted with it."""
        groups: list[list[Path]] = []
        for path in self.files:
            if groups and groups[-1][0].parent in path.parent.parents:
                groups[-1].append(path)
            else:
                groups.append([path])
        return tuple(map(_written_sentence, groups))


def _written_sentence(paths: Sequence[Path]) -> str:
    first, *beside = paths
    size = f"{sum(path.stat().st_size for path in paths) / 1e6:.1f} MB"
    return f"Wrote {first} ({size}{f' with {len(beside)} files in folders beside it' if beside else ''})."


def run(
    request: ExportRequest,
    *,
    progress: EventListener = ignore_events,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> ExportResult:
    """Write a scene in other formats; see :class:`octasplat.engine.operations.base.Run`.

    Tells the steps of a stage ``export``, one for each of several files.

    Raises:
        ExportError: a file could not be written; the others were.
        OctasplatError: the scene cannot be read, or no format takes a name.
    """
    from octasplat.engine.files import dropped_on_export, read_metadata
    from octasplat.engine.files.export_batch import export_batch
    from octasplat.engine.files.glb_parts import parts_left_over
    from octasplat.engine.gaussians.materials import require_materials
    from octasplat.engine.operations.scene_io import check_scenes, open_scene
    from octasplat.engine.operations.written_files import remember_written

    # refused before the scene is read, which may take long
    check_scenes(
        "export", request.files, [request.source], overwrite=request.overwrite, format=request.format
    )
    found = [exporter_for(path, request.format) for path in request.files]
    if request.color is not None and all(exporter.holds_harmonics for exporter in found):
        message = "color goes with formats of one color for each Gaussian and is passed over."
        progress(Warned(message))
    count = len(request.files)
    # where a file is to be written there is room for a large scene, too
    folder = next((path.parent for path in request.files if path.parent.is_dir()), None)
    gaussians = open_scene(request.source, progress, folder=folder)
    if request.materials:
        require_materials(gaussians, request.source)
    # of a lit mesh materials are what is asked for: what is lost of the harmonics does not matter
    lit = "glb" if request.materials else None
    lossy = [path for path, exporter in zip(request.files, found, strict=True) if exporter.name != lit]
    for text in dropped_on_export(gaussians, lossy, request.format, facts=read_metadata(request.source)):
        progress(Warned(text))

    def step(done: int) -> None:
        if done < count and should_stop():  # after the last file there is nothing to stop
            raise CancelledError("The export was stopped.")
        if count > 1:  # one file needs no counting
            progress(PhaseProgress("export", done, count))

    stop_if(should_stop)
    forms = _ExportPreparation(request, gaussians, lambda: step(0), progress, threads)
    files, failed = export_batch(request.files, forms.prepare, on_done=step, format=request.format)
    if failed is not None:
        remember_written("export", files)  # for the same command, once the others can be written
        raise ExportError(failed)
    for path in (path for path in request.files if path.suffix == ".glb"):
        for left in parts_left_over(path, files):
            progress(Warned(f"{left} was not written now: this scene has fewer parts; remove it."))
    return ExportResult(files=files)


class _ExportPreparation:
    """The scene and the options for each format."""

    def __init__(
        self,
        request: ExportRequest,
        gaussians: "FlatGaussians",
        on_pass: Callable[[], None],
        progress: EventListener,
        threads: int,
    ) -> None:
        self._request, self._gaussians = request, gaussians
        self._on_pass, self._progress, self._threads = on_pass, progress, threads

    def prepare(self, exporter: Exporter) -> "tuple[FlatGaussians, ExportOptions]":
        """Return the scene and the options for a format."""
        from octasplat.engine.files.mesh_glb import VIEWER_FORMAT
        from octasplat.engine.files.surface_export import SURFACE_FORMATS
        from octasplat.engine.runs.viewer_glb import prepare_for_viewers, upright_turn

        request, options = self._request, self._export_options
        is_glb = exporter.name == "glb"
        if exporter.name in SURFACE_FORMATS:
            return self._gaussians, options.model_copy(
                update={"surface": lambda: self._surface, "turn_xyzw": upright_turn(request.source)}
            )
        # formats of one color a Gaussian get the color that loses least
        if not (exporter.holds_harmonics or (request.materials and is_glb)):
            gaussians = self._baked_color
        else:
            gaussians = self._gaussians
        if exporter.name == VIEWER_FORMAT or (is_glb and request.for_viewers):
            return prepare_for_viewers(gaussians, request.source, options, request.extent)
        return gaussians, options if is_glb else options.model_copy(update={"light_up": None})

    @cached_property
    def _surface(self) -> "TriangleMesh":
        from octasplat.engine.runs.small_surface import small_surface

        return small_surface(
            self._request.source,
            self._gaussians,
            threads=self._threads,
            scratch=self._request.files[0].parent,
            on_pass=self._on_pass,
        )

    @cached_property
    def _export_options(self) -> ExportOptions:
        from octasplat.engine.files import read_metadata
        from octasplat.engine.operations.axes import light_up

        request = self._request
        choices = {name: getattr(request, name) for name in ExportChoices.model_fields}
        light = light_up(request.source, request.up).tolist() if request.materials else None
        options = {
            **choices,
            "facts": read_metadata(request.source),
            "light_up": light,
        }
        if (q := request.q or self._training_q) is not None:
            options["q"] = q
        return ExportOptions.model_validate(options)

    @property
    def _training_q(self) -> float | None:
        """Return the Q that the scene of a run was trained with."""
        from octasplat.engine.runs.config import read_config
        from octasplat.engine.runs.run_folder import CONFIG, is_run

        source = self._request.source
        known = is_run(source) and (source / CONFIG).exists()
        return read_config(source / CONFIG).train.trace.q if known else None

    @cached_property
    def _baked_color(self) -> "FlatGaussians":
        """Return the scene with constant colors."""
        import numpy as np

        from octasplat.engine.render.bake_color import colors_along, with_constant_color
        from octasplat.engine.runs.baked_scene import BakedScene
        from octasplat.engine.runs.run_folder import is_full_run

        gaussians, source = self._gaussians, self._request.source
        color = self._request.color or ("cameras" if is_full_run(source) else "constant")
        if color == "constant" or gaussians.sh_degree == 0:
            return gaussians
        if color == "cameras":
            return BakedScene(
                gaussians,
                source if is_full_run(source) else None,
                threads=self._threads,
                on_pass=lambda _done, _total: self._on_pass(),
                on_unknown=lambda text: self._progress(Warned(text)),
            ).gaussians
        return with_constant_color(gaussians, colors_along(gaussians, np.array(color)))


OPERATION = Operation(
    "export", "Gaussians to meshes and other formats.", ExportRequest, ExportJobOptions, run
)
