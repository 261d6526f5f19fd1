"""``import``: scenes of other programs to octasplat's PLY."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import BeforeValidator, Field, model_validator

from octasplat.engine.core.events import EventListener, ignore_events
from octasplat.engine.files.channel_columns import ChannelChoice
from octasplat.engine.gaussians.flattening import ImportReport
from octasplat.engine.operations.base import Operation, Options, Result, WritingRequest, never_stop, stop_if
from octasplat.engine.settings import renamed_settings
from octasplat.engine.settings.fields import InputFile, Positional, Spelling


def read_channels(value: object) -> object:
    """Return the names of a text such as ``albedo,metallic``; any other value as it is."""
    if not isinstance(value, str) or value in ("own", "all"):
        return value
    return tuple(name.strip() for name in value.split(",")) if value else "own"


class ImportOptions(Options):
    """Options of which file to read, and how."""

    former_names: ClassVar[renamed_settings.FormerNames] = renamed_settings.IMPORT

    source: Annotated[InputFile, Positional("IN")] = Field(
        description="The scene to read, a file of any known format."
    )
    format: Annotated[str | None, Spelling(metavar="NAME")] = Field(
        None, max_length=40, description="The format, if the file does not show it."
    )
    drop_invalid: bool = Field(
        False, description="Leave out Gaussians with values that are not finite numbers."
    )
    sh_degree: int | None = Field(
        None, ge=0, le=3, description="Keep the spherical harmonics up to this degree only."
    )
    channels: Annotated[
        ChannelChoice,
        BeforeValidator(read_channels, json_schema_input_type=ChannelChoice | str),
        Spelling(metavar="NAMES"),
    ] = Field(
        "own",
        description="Further numbers of each Gaussian to keep, as albedo,metallic; all for whatever is "
        "there; own for those that octasplat wrote.",
    )


class ImportRequest(ImportOptions, WritingRequest):
    """Read IN, a scene of Gaussians in any known format, and write OUT.ply in the layout of 3DGS.

    Formats: 3DGS PLY, compressed PLY (PlayCanvas, SuperSplat), .splat, .spz, .sog or the folder of one, .glb
    with KHR_gaussian_splatting, and octagon meshes (.glb, .ply) as they were exported. A Gaussian with three
    extents loses the smallest; what that means for the scene is told. All other commands read the same
    formats.
    """

    output: Annotated[Path, Positional("OUT.ply")] = Field(description="The scene to write.")

    @model_validator(mode="after")
    def _writes_ply(self) -> "ImportRequest":
        if self.output.suffix.lower() != ".ply":
            raise ValueError(f"{self.output} should end in .ply; octasplat export writes the other formats")
        return self


class ImportResult(Result):
    """The imported scene.

    Attributes:
        report: what reading found and lost.
        channels: names of further numbers of each Gaussian.
    """

    report: ImportReport
    channels: tuple[str, ...] = ()

    def lines(self) -> tuple[str, ...]:
        """Return what was found, and the file with its size."""
        report = self.report
        lines = [f"{report.count:,} Gaussians with spherical harmonics of degree {report.sh_degree}."]
        if report.flattened:
            lines.append(
                f"Thickness of these, over their next extent: {report.median_thickness:.3f} in the median, "
                f"{report.max_thickness:.3f} at most, above one half in {report.thick:,} "
                f"({report.thick / report.count:.1%})."
            )
        else:
            lines.append("All of them were flat already.")
        if report.dropped:
            lines.append(f"Left out: {report.dropped:,}.")
        if self.channels:
            lines.append(f"Channels: {', '.join(self.channels)}.")
        return (*lines, *(f"Wrote {path} ({path.stat().st_size / 1e6:.1f} MB)." for path in self.files))


def run(
    request: ImportRequest,
    *,
    progress: EventListener = ignore_events,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> ImportResult:
    """Read a scene of another program and write it as our own PLY.

    See :class:`octasplat.engine.operations.base.Run`; tells of a stage ``read``.

    Raises:
        ConfigError: the output is the file that is read.
        SceneFileError: the scene cannot be read.
        OutputError: it cannot be written.
    """
    from octasplat.engine.files import read_metadata, read_scene
    from octasplat.engine.files.gaussian_ply import write_gaussian_ply
    from octasplat.engine.operations.scene_io import check_scenes, report_dropped_on_import

    source: Path = request.source
    check_scenes("import", [request.output], [source], overwrite=request.overwrite)
    gaussians, report = read_scene(
        source,
        request.format,
        drop_invalid=request.drop_invalid,
        channels=request.channels,
        progress=progress,
    )
    report_dropped_on_import(source, report, progress)
    degree = request.sh_degree
    if degree is not None and degree < gaussians.sh_degree:
        # a copy, so that the longer array is freed
        gaussians.sh = gaussians.sh[:, : (degree + 1) ** 2].copy()
    stop_if(should_stop)
    write_gaussian_ply(gaussians, request.output, facts=read_metadata(source))
    return ImportResult(files=(request.output,), report=report, channels=tuple(gaussians.channels))


OPERATION = Operation(
    "import", "Splats of any format to a scene of flat Gaussians.", ImportRequest, ImportOptions, run
)
