"""Kinds of jobs that make pictures: new views, and other light."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from octasplat.engine.errors import Cancelled
from octasplat.engine.events import Listener
from octasplat.engine.light.stage_file import named_files
from octasplat.engine.operations.base import Operation
from octasplat.engine.operations.costs import (
    Estimate,
    estimate_relight,
    estimate_render,
    image_bytes,
    rendered_pixels,
)
from octasplat.engine.operations.relight import RelightOptions
from octasplat.engine.operations.render import RenderOptions
from octasplat.engine.photograph_sizes import Sizes
from octasplat.engine.stages import stopping
from octasplat.workers.store.names import check_name
from octasplat.workers.work.kept_frames import KeptFrames
from octasplat.workers.work.kinds.demands import Demand
from octasplat.workers.work.kinds.operation_kind import OperationKind
from octasplat.workers.work.task import FRAMES, Task

VIDEOS = {"turntable": "turntable.mp4", "path": "path.mp4"}
"""Name of the video among the results, by mode."""
IMAGES = "views"
"""Folder of the images among the results."""
_PIXELS_OF = {"turntable": "frames", "path": "camera_path", "camera": "width_px", "views": "max_side"}
"""The option that decides on the pixels, by mode."""


class Pictures(OperationKind):
    """Pictures of a scene; an attempt goes on from the images that earlier ones have stored."""

    def __init__(self, operation: Operation[Any, Any], *, title: str, source_files: Sequence[str]) -> None:
        super().__init__(
            operation, title=title, stages=("render",), source_files=source_files, tells_stages=True
        )
        self.takes_files = True

    def places(self, task: Task, options: Any) -> dict[str, Any]:
        """Return where a job reads and writes, and how it goes on."""
        frames = task.run / FRAMES
        output = task.results / VIDEOS[options.mode] if options.format == "mp4" else frames
        return {
            "source": task.source, "output": output, "frames_folder": frames, "resume": True, "or_anew": True,
        }  # fmt: skip

    @contextmanager
    def listening(self, task: Task) -> Iterator[Listener]:
        """Yield what hears the events; what is done is stored when the work is stopped."""
        frames = KeptFrames(task.listener)
        try:
            yield stopping(frames, task.should_stop)
        except Cancelled:
            frames.store()
            raise

    def result_name(self, path: Path) -> str:
        """Return the name among the results of an image."""
        return f"{IMAGES}/{path.as_posix()}"


class Render(Pictures):
    """New views."""

    def named_files(self, options: RenderOptions) -> Iterable[tuple[str, str]]:
        """Return the files of the stage."""
        for key, name in named_files(options.stage) if options.stage is not None else ():
            yield f"stage.{key.replace('[', '.').replace(']', '')}", name

    def places(self, task: Task, options: Any) -> dict[str, Any]:
        """Return where a job reads and writes, the stage's files among them.

        Raises:
            NameRefused: the stage names a file outside of the job's folder.
        """
        for _, name in self.named_files(options):
            check_name(name)  # as the service did
        places = {**super().places(task, options), "stage_folder": task.files}
        if options.preview:
            places["output"] = task.run / FRAMES / f"preview.{options.format}"
        return places

    def demands(self, options: RenderOptions, sizes: Sequence[Sizes]) -> tuple[Demand, ...]:
        """Return the pixels and paths of all images."""
        pixels = rendered_pixels(options, sizes)
        always = (
            Demand(_PIXELS_OF[options.mode], "render_pixels", pixels),
            Demand("format", "workspace_bytes", image_bytes(options, sizes)),
        )
        if options.stage is None:
            return always
        samples = options.stage.integrator.samples
        return (*always, Demand("stage.integrator.samples", "render_paths", pixels * samples))

    def estimate(self, options: RenderOptions, sizes: Sequence[Sizes], cores: int) -> Estimate:
        """Return the time and memory that it takes."""
        return estimate_render(options, sizes, cores)


class Relight(Pictures):
    """Other light."""

    def demands(self, options: RelightOptions, sizes: Sequence[Sizes]) -> tuple[Demand, ...]:
        """Return the pixels and paths of all images."""
        pixels, count = rendered_pixels(options, sizes), len(options.environments)
        return (
            Demand(_PIXELS_OF[options.mode], "render_pixels", pixels * count),
            Demand("format", "workspace_bytes", image_bytes(options, sizes, count)),
            Demand("samples", "render_paths", pixels * count * options.samples_per_pixel),
        )

    def estimate(self, options: RelightOptions, sizes: Sequence[Sizes], cores: int) -> Estimate:
        """Return the time and memory that it takes."""
        return estimate_relight(options, sizes, cores)
