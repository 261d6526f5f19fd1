"""Kinds of jobs that render images: new views, and other light."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from octasplat.engine.core.errors import CancelledError
from octasplat.engine.core.events import EventListener
from octasplat.engine.core.portable_names import check_name
from octasplat.engine.core.progress import stop_when_asked
from octasplat.engine.dataset.image_sizes import ImageSizes
from octasplat.engine.operations.base import Operation
from octasplat.engine.operations.cost_model import (
    Estimate,
    estimate_relight,
    estimate_render,
    image_bytes,
    rendered_pixels,
)
from octasplat.engine.operations.relight import RelightOptions
from octasplat.engine.operations.render import RenderOptions
from octasplat.engine.pathtracing.stage.model import StageMesh
from octasplat.engine.pathtracing.stage.stage_file import glass_meshes, referenced_files
from octasplat.workers.worker.frame_checkpoints import FrameCheckpoints
from octasplat.workers.worker.job_kinds.operation_kind import OperationKind
from octasplat.workers.worker.job_kinds.resource_limits import ResourceDemand
from octasplat.workers.worker.task import FRAMES_FOLDER, Task

VIDEO_NAMES = {"turntable": "turntable.mp4", "path": "path.mp4"}
"""Name of the video among the results, by mode."""
IMAGE_FOLDER = "views"
"""Folder of the images among the results."""
_PIXEL_OPTIONS = {"turntable": "frames", "path": "camera_path", "camera": "width_px", "views": "max_side"}
"""The option that decides on the pixels, by mode."""


class ImageKind(OperationKind):
    """Base of kinds that render images; an attempt resumes from the stored images of earlier ones."""

    def __init__(self, operation: Operation[Any, Any], *, title: str, source_files: Sequence[str]) -> None:
        super().__init__(
            operation, title=title, stages=("render",), source_files=source_files, reports_stages=True
        )
        self.takes_files = True

    def request_paths(self, task: Task, options: Any) -> dict[str, Any]:
        """Return where a job reads and writes, and how it goes on."""
        frames = task.run / FRAMES_FOLDER
        output = task.results / VIDEO_NAMES[options.mode] if options.format == "mp4" else frames
        return {
            "source": task.source, "output": output, "frames_folder": frames, "resume": True, "or_anew": True,
        }  # fmt: skip

    @contextmanager
    def progress_callback(self, task: Task) -> Iterator[EventListener]:
        """Yield what hears the events; what is done is stored when the work is stopped."""
        frames = FrameCheckpoints(task.progress)
        try:
            yield stop_when_asked(frames, task.should_stop)
        except CancelledError:
            frames.request_checkpoint()
            raise

    def removes_stored_frames(self, options: Any) -> bool:
        """Return whether the images are the results themselves; a video is made of its frames at the end."""
        return bool(options.format != "mp4")

    def result_name(self, path: Path) -> str:
        """Return the name among the results of an image."""
        return f"{IMAGE_FOLDER}/{path.as_posix()}"


class RenderKind(ImageKind):
    """Kind of jobs that render new views."""

    def named_files(self, options: RenderOptions) -> Iterable[tuple[str, str]]:
        """Return the files of the stage."""
        for key, name in referenced_files(options.stage) if options.stage is not None else ():
            yield f"stage.{key.replace('[', '.').replace(']', '')}", name

    def glass_meshes(self, options: RenderOptions) -> Mapping[int, StageMesh]:
        """Return the meshes of the stage that are to be glass."""
        return {} if options.stage is None else glass_meshes(options.stage)

    def request_paths(self, task: Task, options: Any) -> dict[str, Any]:
        """Return where a job reads and writes, the stage's files among them.

        Raises:
            FileNameError: the stage names a file outside of the job's folder.
        """
        for _, name in self.named_files(options):
            check_name(name)  # as the service did
        places = {**super().request_paths(task, options), "stage_folder": task.files}
        if options.preview:
            places["output"] = task.run / FRAMES_FOLDER / f"preview.{options.format}"
        return places

    def resource_demands(
        self, options: RenderOptions, sizes: Sequence[ImageSizes]
    ) -> tuple[ResourceDemand, ...]:
        """Return the pixels and paths of all images."""
        pixels = rendered_pixels(options, sizes)
        always = (
            ResourceDemand(_PIXEL_OPTIONS[options.mode], "render_pixels", pixels),
            ResourceDemand("format", "workspace_bytes", image_bytes(options, sizes)),
        )
        if options.stage is None:
            return always
        samples = options.stage.integrator.samples
        return (*always, ResourceDemand("stage.integrator.samples", "render_paths", pixels * samples))

    def estimate(self, options: RenderOptions, sizes: Sequence[ImageSizes], cores: int) -> Estimate:
        """Return the time and memory that it takes."""
        return estimate_render(options, sizes, cores)


class RelightKind(ImageKind):
    """Kind of jobs that render under other environment light."""

    def resource_demands(
        self, options: RelightOptions, sizes: Sequence[ImageSizes]
    ) -> tuple[ResourceDemand, ...]:
        """Return the pixels and paths of all images."""
        pixels, count = rendered_pixels(options, sizes), len(options.environments)
        return (
            ResourceDemand(_PIXEL_OPTIONS[options.mode], "render_pixels", pixels * count),
            ResourceDemand("format", "workspace_bytes", image_bytes(options, sizes, count)),
            ResourceDemand("samples", "render_paths", pixels * count * options.samples_per_pixel),
        )

    def estimate(self, options: RelightOptions, sizes: Sequence[ImageSizes], cores: int) -> Estimate:
        """Return the time and memory that it takes."""
        return estimate_relight(options, sizes, cores)
