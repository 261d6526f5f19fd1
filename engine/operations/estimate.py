"""``estimate``: the cost of a reconstruction, before it starts."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from octasplat.engine.core.events import EventListener, Noted, Warned, ignore_events
from octasplat.engine.core.threads import available_threads
from octasplat.engine.dataset.image_sizes import ImageSizes
from octasplat.engine.operations.base import Operation, Request, Result, never_stop
from octasplat.engine.operations.photograph_sizes import photograph_sizes
from octasplat.engine.operations.reconstruct import PlainReconstructOptions
from octasplat.engine.settings.fields import Positional, ReadPath, Spelling, Unit

if TYPE_CHECKING:
    from octasplat.engine.operations.block_options import BlockOptions
    from octasplat.engine.operations.cost_model import Estimate
    from octasplat.engine.runs.config import ReconstructionConfig


class EstimateOptions(PlainReconstructOptions):
    """Options of the reconstruction to estimate, and the number of cores."""

    cores: Annotated[int, Unit("cores"), Spelling(metavar="N")] = Field(
        0, ge=0, description="Cores of the machine to reckon with; 0 takes those of this one."
    )


class EstimateRequest(EstimateOptions, Request):
    """Estimate the time, memory and disk that the reconstruction of PHOTOS takes, within a factor of two.

    The options are those of reconstruct; for blocks octasplat plan has them. Photographs are not decoded:
    their sizes are enough.
    """

    source: Annotated[Path, Positional("PHOTOS"), ReadPath()] = Field(
        description="The folder of the photographs, or a video, of which no frames are written."
    )
    fps: Annotated[float, Unit("images/s"), Spelling(metavar="N")] = Field(
        2.0, gt=0, le=120, description="Of a video: so many frames of each second would be taken."
    )


class EstimateResult(Result):
    """The cost of a reconstruction, within a factor of two.

    Attributes:
        photographs: number of photographs of each size.
        cpu_seconds: time of all cores together.
        seconds: time by the clock, with nothing else to do.
        cores: number of cores that is reckoned with.
        memory_bytes: largest private memory of the process.
        disk_bytes: least size of the folder of the run.
        finds_poses: whether poses are found first.
        poses_seconds: for finding them, in ``seconds``.
        cold_start_seconds: for kernels that are not compiled yet, in ``cpu_seconds`` and ``seconds``.
        text: the same in words.
    """

    photographs: tuple[ImageSizes, ...]
    cpu_seconds: float
    seconds: float
    cores: int
    memory_bytes: int
    disk_bytes: int
    finds_poses: bool
    poses_seconds: float
    cold_start_seconds: float
    text: str

    def lines(self) -> tuple[str, ...]:
        """Return the estimate in a sentence."""
        count = sum(sizes.count for sizes in self.photographs)
        disk = f"{self.disk_bytes / 1e6:,.0f} MB of disk"
        return (f"{count} photographs: {self.text}, and at least {disk}; within a factor of two.",)


def run(
    request: EstimateRequest,
    *,
    progress: EventListener = ignore_events,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> EstimateResult:
    """Estimate a reconstruction; see :class:`octasplat.engine.operations.base.Run`.

    Raises:
        DatasetError: there are no photographs, or one cannot be read.
        ConfigError: a setting cannot be used.
    """
    from octasplat.engine.dataset.video_frames import is_video, planned_frames
    from octasplat.engine.poses.photographs import locate_scene, notes_on_files

    config, cores = request.config(), request.cores or threads  # 0 of both: the cores of this machine
    if is_video(request.source):
        frames = planned_frames(request.source, request.fps)
        # a video has no model: poses are found
        estimate = estimate_photographs([frames], config.with_poses_decided(False), cores)
        return EstimateResult(photographs=(frames,), **estimate.model_dump())
    scene = locate_scene(request.source)
    for sentence in notes_on_files(scene):
        progress(Warned(sentence))
    if config.region is not None:
        progress(Noted("The estimate is of the whole scene; the training of a region takes less."))
    sizes = photograph_sizes(scene)
    found = estimate_scene(scene, config, sizes, cores)
    return EstimateResult(photographs=tuple(sizes), **found.model_dump())


def estimate_scene(
    scene: Path,
    config: "ReconstructionConfig",
    sizes: Sequence[ImageSizes],
    cores: int = 0,
    blocks: "BlockOptions | None" = None,
) -> "Estimate":
    """Return the estimate of a reconstruction on this machine, with the kernels that it lacks.

    Args:
        scene: folder of the scene.
        config: settings of the reconstruction.
        sizes: of the photographs.
        cores: to reckon with; 0 takes those of this machine.
        blocks: how the scene is to be trained in blocks; None stands for not at all.
    """
    from octasplat.engine.dataset.model_sources import has_model

    config, found_by = config.with_poses_decided(has_model(scene)).without_run_of_model()
    if found_by is not None:  # a run whose poses are taken
        config = config.model_copy(update={"poses": "given"})
    return estimate_photographs(sizes, config, cores, blocks)


def estimate_photographs(
    sizes: Sequence[ImageSizes],
    config: "ReconstructionConfig",
    cores: int = 0,
    blocks: "BlockOptions | None" = None,
) -> "Estimate":
    """Return the estimate for photographs of these sizes, where it is decided whether poses are found."""
    from octasplat.engine.operations.block_cost import estimate_with_blocks
    from octasplat.engine.operations.block_options import BlockOptions
    from octasplat.engine.operations.precompile import cold_start_seconds

    found = estimate_with_blocks(config, blocks or BlockOptions(), sizes, cores or available_threads())
    return found.with_cold_start(cold_start_seconds(["reconstruct"]))


OPERATION = Operation(
    "estimate",
    "Estimate what a reconstruction takes, before it is begun.",
    EstimateRequest,
    EstimateOptions,
    run,
)
