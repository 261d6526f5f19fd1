"""``info``: facts on a scene."""

from collections.abc import Callable
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field, InstanceOf, field_validator

from octasplat.engine.core.events import EventListener, ignore_events
from octasplat.engine.core.georeference import Georeference
from octasplat.engine.core.local_origin import NO_ORIGIN, describe_origin, is_set, user_position
from octasplat.engine.evaluate.scene_statistics import (
    OPACITY_EDGES,
    QUANTILES,
    HitStatistics,
    SceneStatistics,
)
from octasplat.engine.operations.axes import Axis, axis_named
from octasplat.engine.operations.base import Operation, Options, Result, WritingRequest, never_stop, stop_if
from octasplat.engine.settings import renamed_settings
from octasplat.engine.settings.fields import DatasetFolder, Source, Spelling

_BAR = 24


class InfoOptions(Options):
    """Options of looking at a scene."""

    up: Axis | None = Field(None, description="The axis of a file that points up.  [default: -y]")


class InfoRequest(InfoOptions, WritingRequest):
    """Tell what is in IN, the folder of a run or a file of Gaussians in any splat format.

    Counts, bounds, the direction that is up, harmonics, opacities, sizes and memory. With --rays also how
    many Gaussians a ray meets and, on a terminal, a small picture.
    """

    former_names: ClassVar[renamed_settings.FormerNames] = renamed_settings.DATASET

    source: Source = Field(description="The scene to look at: the folder of a run, or a file of any format.")
    dataset: DatasetFolder = Field(
        None,
        description="Take the cameras of the photographs in this folder.  [default: those the run keeps]",
    )
    rays: bool = Field(
        False,
        description="Trace a small picture, too, which tells how many Gaussians a ray meets; the first time "
        "this compiles the tracer. --picture does so as well.",
    )
    picture: Annotated[Path | None, Spelling(metavar="FILE.png")] = Field(
        None, description="Write a small picture of the scene, too."
    )
    output: Annotated[Path | None, Spelling(("-o", "--output"), metavar="FILE.json")] = Field(
        None, description="Write everything as JSON, too."
    )

    @field_validator("picture")
    @classmethod
    def _check_picture(cls, picture: Path | None) -> Path | None:
        if picture is not None and picture.suffix.lower() != ".png":
            raise ValueError(f"{picture} is no name of a .png, which is what is written")
        return picture


class InfoResult(Result):
    """Facts on a scene.

    Attributes:
        source: the file or the folder of the run.
        size_bytes: of the file; None of a run.
        photographs: how many the run was made from; None of a file.
        up_world: the direction that points up; known of a run, a guess of a file.
        origin_world: where the scene has its origin; positions of ``scene`` are about it.
        georeference: where the scene lies and how large it is; None where that is not known.
        scene: counts, bounds and sizes of the Gaussians.
        hits: how many Gaussians the rays of the picture meet; None where none was traced.
        picture_srgb: the scene from the place of the run's first photograph, or from a turntable; display
            values, of shape (height, width, 3); None where none was traced.
    """

    source: Path
    size_bytes: int | None
    photographs: int | None
    up_world: tuple[float, float, float]
    origin_world: tuple[float, float, float] = NO_ORIGIN
    georeference: Georeference | None = None
    scene: InstanceOf[SceneStatistics]
    hits: InstanceOf[HitStatistics] | None = None
    picture_srgb: InstanceOf[np.ndarray] | None = Field(None, repr=False)

    def facts(self) -> dict[str, Any]:
        """Return everything but the picture, as JSON values."""
        scene = asdict(self.scene)
        # numpy arrays are no JSON
        scene["seen"] = {
            name: value.tolist() if hasattr(value, "tolist") else value
            for name, value in scene["seen"].items()
        }
        return {
            "source": str(self.source),
            "photographs": self.photographs,
            "up_world": list(self.up_world),
            **({"origin_world": list(self.origin_world)} if is_set(self.origin_world) else {}),
            **(
                {}
                if self.georeference is None
                else {"georeference": self.georeference.model_dump(mode="json")}
            ),
            **scene,
            "opacity_edges": OPACITY_EDGES,
            "scale_quantiles_of": QUANTILES,
            **({"hits": asdict(self.hits)} if self.hits is not None else {}),
        }

    def lines(self) -> tuple[str, ...]:
        """Return the facts in words, and a histogram of the opacities."""
        scene, hits = self.scene, self.hits
        size = f", {self.size_bytes / 1e6:.1f} MB" if self.size_bytes else ""
        made_from = f", a run of {self.photographs} photographs" if self.photographs else ""
        channels = ", ".join(f"{name} ({width})" for name, width in scene.channels.items())
        up = "of the photographs" if self.photographs else "as most files have it; --up says otherwise"
        quantiles = " / ".join(f"{value:.3g}" for value in scene.scale_quantiles)
        box, solid, origin = scene.box, scene.box_solid, self.origin_world

        def place(values: Any) -> str:
            return user_position(np.asarray(values, np.float64), origin)

        return (
            f"{self.source}: {scene.count:,} Gaussians{size}{made_from}",
            f"  memory      {scene.megabytes:.1f} MB, harmonics of degree {scene.sh_degree}"
            + (f", channels {channels}" if channels else ""),
            f"  up          {_format_vector(self.up_world)} ({up})",
            *((f"  origin      {describe_origin(origin)} (of what files hold)",) if is_set(origin) else ()),
            *(() if self.georeference is None else (f"  place       {self.georeference.describe()}",)),
            f"  centres     {place(box.low_world)} to {place(box.high_world)}",
            f"  solid part  {place(solid.low_world)} to {place(solid.high_world)}",
            f"  seen        around {place(scene.seen.centre_world)}, "
            f"{2 * scene.seen.half_height:.3g} high, {2 * scene.seen.radius:.3g} across",
            f"  size        {quantiles} (larger deviation; 1, 10, 50, 90, 99 in 100)",
            f"  shape       {scene.flatness_median:.2g} (smaller over larger deviation, median)",
            *(
                ()
                if hits is None
                else (
                    f"  hits a ray  {hits.mean:.0f}, of one in 20 more than {hits.p95:.0f}; "
                    f"{100 * hits.share:.0f} % of the picture's rays meet any",
                )
            ),
            "  opacity",
            *self._opacity_histogram_lines(),
        )

    def _opacity_histogram_lines(self) -> tuple[str, ...]:
        counts = self.scene.opacity_counts
        return tuple(
            f"    {low:4.2f} to {high:4.2f}  {'#' * round(_BAR * count / max(counts)):<{_BAR}}  {count:,}"
            for (low, high), count in zip(pairwise(OPACITY_EDGES), counts, strict=True)
        )


def run(
    request: InfoRequest,
    *,
    progress: EventListener = ignore_events,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> InfoResult:
    """Collect facts on a scene; see :class:`octasplat.engine.operations.base.Run`.

    Raises:
        ConfigError: the cameras of the photographs share no up direction, or a file to write is
            the scene.
        SceneFileError: the scene cannot be read.
        OutputError: there is no scene yet, or a file cannot be written.
    """
    from octasplat.engine.core.writing import write_json
    from octasplat.engine.files import read_metadata
    from octasplat.engine.operations.render_source import open_stage_scene
    from octasplat.engine.operations.scene_inspection import inspect_scene, trace_picture
    from octasplat.engine.operations.written_files import check_targets
    from octasplat.engine.render.image_files import write_png

    source = request.source
    files = tuple(path for path in (request.output, request.picture) if path is not None)
    check_targets("info", files, [source, request.dataset], overwrite=request.overwrite)
    opened = open_stage_scene(source, progress, dataset=request.dataset, threads=threads)
    up = None if request.up is None else axis_named(request.up)
    found = inspect_scene(opened, up)
    traced = trace_picture(opened, up) if request.rays or request.picture is not None else None
    x, y, z = found.up_world.tolist()
    known = read_metadata(source)
    result = InfoResult(
        files=files,
        folder=None if request.output is None else request.output.parent,
        source=source,
        size_bytes=source.stat().st_size if source.is_file() else None,
        photographs=found.photographs,
        up_world=(x, y, z),
        origin_world=known.origin_world,
        georeference=known.georeference,
        scene=found.scene,
        hits=None if traced is None else traced.hits,
        picture_srgb=None if traced is None else traced.rgb_srgb,
    )
    stop_if(should_stop)
    if request.picture is not None and traced is not None:
        write_png(request.picture, traced.rgb_srgb)
    if request.output is not None:
        write_json(request.output, result.facts())
    return result


def _format_vector(values: Any) -> str:
    return " ".join(f"{value:.4g}" for value in values)


OPERATION = Operation(
    "info", "Describe what is in a scene: counts, bounds, sizes, cost.", InfoRequest, InfoOptions, run
)
