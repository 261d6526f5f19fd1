"""Cost model: time and memory of a job before it starts, for users and for limits.

The figures come from runs on photographed scenes (``docs/notes/scenes.md``); ``benchmarks/estimates.py``
compares anew. What the photographs show decides as much as how many they are, so that an estimate is right
within a factor of two, not better. Imports neither torch nor numba.
"""

from collections.abc import Mapping, Sequence

from pydantic import BaseModel, computed_field

from octasplat.engine.core.durations import format_duration
from octasplat.engine.dataset.image_sizes import ImageSizes
from octasplat.engine.operations.picture_memory import picture_bytes
from octasplat.engine.operations.relight import RelightOptions
from octasplat.engine.operations.render import RenderOptions
from octasplat.engine.operations.render_options import PictureOptions
from octasplat.engine.poses.config import DEFAULT_CONFIG, MAX_IMAGE_SIDE_PX
from octasplat.engine.runs.config import ReconstructionConfig
from octasplat.engine.runs.result_files import SURFACE_GLB
from octasplat.engine.train.config import (
    KEPT_BATCHES,
    TrainConfig,
    iteration_count,
    max_gaussian_count,
    residual_cost_share,
    uses_shared_sort,
)

_START_CPU_SECONDS = 16.0
_FEATURES_CPU_SECONDS_PER_PIXEL = 1.6e-6
_MATCH_CPU_SECONDS_PER_PAIR = 0.1
_PRESELECT_CPU_SECONDS_PER_PAIR = 0.002
_MAP_CPU_SECONDS_PER_PHOTOGRAPH = 0.2
"""For finding poses, measured with 14 photographs of 960 x 638 pixels and 25 of 538 x 960."""
_LARGE_FEATURES_CPU_SECONDS_PER_PIXEL = 7.0e-7
_LARGE_MATCH_CPU_SECONDS_PER_PAIR = 0.077
_LARGE_MAP_CPU_SECONDS_PER_PHOTOGRAPH = 1.1
"""The same in captures of more photographs than ``quick_look_up_to``, measured with 2,000 of 12 MP."""
_READ_CPU_SECONDS_PER_PIXEL = 0.9e-8
"""To read photographs to their ends."""
_IMPORT_CPU_SECONDS_PER_PIXEL = 1.1e-8
"""To read them once more by COLMAP, which uses one core."""
_DECODE_CPU_SECONDS_PER_PIXEL = 1.2e-8
"""By COLMAP."""
_LOAD_CPU_SECONDS_PER_PIXEL = 2.0e-8
"""Measured with 2,000 JPEG files of 12 MP: 1.3e-8; PNG takes longer."""
_LIFT_CPU_SECONDS_PER_POINT = 7.0e-5
_EVALUATE_CPU_SECONDS_PER_PIXEL = 2.2e-6
"""2.6e-6 for 3 MP on a busy machine, of which tracing takes 1.0e-6 and more the more Gaussians there are."""
_EVALUATE_CPU_SECONDS_PER_VIEW = 0.35
"""For what does not shrink with the picture: 125 views of 320 x 240 pixels took 73 s."""
_RENDER_CPU_SECONDS_PER_PIXEL = 1.5e-6
_EXPORT_CPU_SECONDS_PER_GAUSSIAN = 1.0e-4
"""For the octagon meshes and the one color of each Gaussian that they have."""
_SURFACE_CPU_SECONDS = 9.0
"""For the small surface, whose size does not depend on the scene."""
_RENDER_START_CPU_SECONDS = 3.0
"""Measured for a picture of 320 x 240 pixels: 2.6 s, with compiled kernels there."""
_PATH_CPU_SECONDS = 1.0e-5
"""For a path of a stage among 100,000 Gaussians (``benchmarks/light.py``)."""
_RAY_CPU_SECONDS = 5.9e-6
"""For a ray, forward and backward, of a training that ends with 100,000 Gaussians."""
_LEAST_RAY_CPU_SECONDS = 1.0e-6
_RAY_POWER = 0.8
_FAR_RAY_POWER = 0.45
"""Powers of the number of Gaussians by which it grows: up to the 200,000 of the runs that it was fitted to,
and beyond, where an iteration was measured with 100,000 and 1,000,000 (``benchmarks/growth.py``)."""
_FITTED_GAUSSIANS = 200_000
_MATERIAL_RAY_CPU_SECONDS = 2.1e-5
"""For a ray with what it reflects, of a training with materials of so many Gaussians."""
_MATERIAL_GAUSSIANS = 80_000
_SHADED_RAY_BYTES = 54
"""For a ray of each batch that this fit keeps, beyond what the training had and is free by then: 113 MB more
were measured with 256 batches of 8,192 rays (a lamp of 64 views of 200 px, ``fast``)."""
_MATERIAL_EVALUATE_CPU_SECONDS_PER_PIXEL = 5.5e-5
"""With four to sixteen rays per pixel and what they reflect: 8 to 10 s per picture of 400 x 400 pixels."""
_SHARED_SORT_SAVING = 0.6
"""Share of a ray's time that is saved where the rays of a window composite in one order
(``docs/notes/speed.md``, "One order")."""
_SINGLE_RAY_CPU_SECONDS = 10.8e-6
"""For a ray that comes alone, as the preset redisplats has them."""
_PAPER_GAUSSIANS = 60_000
"""What clone and split comes to, whatever its cap."""
_START_BYTES = 300 << 20
_MODEL_BYTES_PER_PHOTOGRAPH = 400_000
"""For a model of COLMAP while it is read, of 3,000 to 8,000 features in each; 590,000 were measured
where 7,400 of them showed points."""
_MAPPED_BYTES_PER_PHOTOGRAPH = 2_500_000
"""For the search for poses: 3.8 GB were measured where 1,432 of 2,000 photographs had been placed."""
_MATERIAL_START_BYTES, _MATERIAL_TRAIN_BYTES = 1_370 << 20, 500 << 20
"""What materials take whatever the photographs, as they begin and later on."""
_RAY_BYTES = 21_000
_PIXEL_BYTES = 290
"""For a pixel of the largest photograph, when a view is measured; what training needed is free by then."""
_MATERIAL_PIXEL_BYTES = 600
"""The same with materials, whose pictures have more layers, and several rays a pixel."""
_CACHED_PIXEL_BYTES = 3
_IMAGE_PIXEL_BYTES = {"exr": 7.0, "png": 0.4, "mp4": 0.4}
_MAX_IMAGE_PIXEL_BYTES = {"exr": 30.0, "png": 1.2, "mp4": 1.2}
"""The least and the most that a pixel of a rendered image takes on disk, as measured where most of the image
is empty and where nothing is (30 and 1.1). Images of a film are kept as PNG until it is written."""
_CORE_POWER = 0.79
"""Two cores train 1.73 times as fast as one."""
_TYPICAL_RENDER_GAUSSIANS = 100_000


class Estimate(BaseModel):
    """The estimated cost of a job, within a factor of two.

    Attributes:
        cpu_seconds: of all cores together.
        seconds: by the clock, on so many cores with nothing else to do.
        cores: of the machine that is reckoned with.
        memory_bytes: largest private memory of the job's process.
        disk_bytes: the least that its folder takes on the worker's disk; 0 where nobody knows.
        max_disk_bytes: the most that it may take; 0 where nobody knows.
        finds_poses: whether poses are found first.
        poses_seconds: by the clock, for finding them, in ``seconds``.
        cold_start_seconds: for kernels that are not compiled yet, in ``cpu_seconds`` and ``seconds``.
        stage_seconds: ``seconds`` by stage, without a cold start; empty where nobody knows.
    """

    cpu_seconds: float
    seconds: float
    cores: int
    memory_bytes: int
    finds_poses: bool = False
    poses_seconds: float = 0.0
    disk_bytes: int = 0
    max_disk_bytes: int = 0
    cold_start_seconds: float = 0.0
    stage_seconds: dict[str, float] = {}

    def with_cold_start(self, seconds: float) -> "Estimate":
        """Return the estimate where kernels are compiled first, which takes one core so long."""
        return self.model_copy(
            update={
                "cpu_seconds": round(self.cpu_seconds + seconds, 1),
                "seconds": round(self.seconds + seconds, 1),
                "cold_start_seconds": round(seconds, 1),
            }
        )

    @computed_field  # type: ignore[prop-decorator]
    @property
    def text(self) -> str:
        """Return the estimate in words."""
        cores = f"{self.cores} core{'s' if self.cores > 1 else ''}"
        parts = [
            f"{format_duration(seconds)} of it {what}"
            for seconds, what in (
                (self.poses_seconds, "to find the poses"),
                (self.cold_start_seconds, "to compile kernels"),
            )
            if seconds >= 1
        ]
        of_it = f" ({' and '.join(parts)})" if parts else ""
        return (
            f"about {format_duration(self.seconds)} on {cores}{of_it} "
            f"and {self.memory_bytes / 1e9:.1f} GB of memory"
        )


def estimate_reconstruction(
    options: ReconstructionConfig, photographs: Sequence[ImageSizes], cores: int
) -> Estimate:
    """Return the estimate of a reconstruction of these photographs on this number of cores."""
    train = options.train
    shrunk = [capped_sizes(sizes, options.max_side) for sizes in photographs]
    count = sum(sizes.count for sizes in shrunk)
    pixels = sum(sizes.width_px * sizes.height_px * sizes.count for sizes in shrunk)
    largest = max((sizes.width_px * sizes.height_px for sizes in shrunk), default=0)
    held_out_views = held_out_count(options, count)
    trained_on = training_pixels(options, photographs)
    iterations = iteration_count(train, trained_on)
    gaussians = _expected_gaussians(train, trained_on)
    training_cpu_seconds = iterations * train.rays_per_batch * _ray_cpu_seconds(train, gaussians)
    if options.minutes is not None:  # the time is given: it is used up
        training_cpu_seconds = 60 * options.minutes * max(1, cores) ** _CORE_POWER
    else:
        training_cpu_seconds *= 1 + residual_cost_share(train)
    residual_cpu_seconds = training_cpu_seconds * (1 - 1 / (1 + residual_cost_share(train)))
    materials = train.materials.learn
    each_pixel = _MATERIAL_EVALUATE_CPU_SECONDS_PER_PIXEL if materials else _EVALUATE_CPU_SECONDS_PER_PIXEL
    full_pixels = sum(sizes.width_px * sizes.height_px * sizes.count for sizes in photographs)
    finds_poses = options.poses == "auto"
    search, serial = _pose_search_cpu_seconds(photographs) if finds_poses else ({}, {})
    lifting = _LIFT_CPU_SECONDS_PER_POINT * min(train.initial_points, gaussians) * train.plane_sweep_init
    stages = {
        **search,
        "load": _START_CPU_SECONDS + _LOAD_CPU_SECONDS_PER_PIXEL * full_pixels,
        "train": lifting + training_cpu_seconds - residual_cpu_seconds,
        **({"residual": residual_cpu_seconds} if residual_cpu_seconds else {}),
        "evaluate": held_out_views * (_EVALUATE_CPU_SECONDS_PER_VIEW + each_pixel * pixels / max(count, 1)),
        "export": _export_cpu_seconds(options, gaussians),
    }
    cpu_seconds = sum(stages.values())
    training = _gaussian_bytes(train.sh_degree) * gaussians + _RAY_BYTES * max(
        train.rays_per_batch, train.probe_rays
    )
    if materials:
        # the largest of both phases: they follow each other
        training = max(training + _MATERIAL_TRAIN_BYTES, _MATERIAL_START_BYTES)
        if residual_cpu_seconds:
            training += KEPT_BATCHES * train.rays_per_batch * _SHADED_RAY_BYTES
    each_pixel_bytes = _MATERIAL_PIXEL_BYTES if materials else _PIXEL_BYTES
    memory = _START_BYTES + model_bytes(count) + max(training, each_pixel_bytes * largest)
    if finds_poses:  # before the training, by a process of its own
        memory = max(memory, _START_BYTES + _MAPPED_BYTES_PER_PHOTOGRAPH * count)
    disk = reconstruction_bytes(options, photographs)
    found = _make_estimate(
        cpu_seconds, memory, cores, finds_poses=finds_poses, disk_bytes=disk, stages=stages, serial=serial
    )
    searching = sum(found.stage_seconds[name] for name in search)
    return found.model_copy(update={"poses_seconds": round(searching, 1)})


def gaussians_within(
    options: ReconstructionConfig, photographs: Sequence[ImageSizes], memory_bytes: int
) -> int:
    """Return how many Gaussians a training in so much memory may have; 0 where it holds not even the rest."""
    train = options.train
    shrunk = [capped_sizes(sizes, options.max_side) for sizes in photographs]
    largest = max((sizes.width_px * sizes.height_px for sizes in shrunk), default=0)
    start = _START_BYTES + model_bytes(sum(sizes.count for sizes in shrunk))
    if memory_bytes < start + _PIXEL_BYTES * largest:
        return 0
    left = memory_bytes - start - _RAY_BYTES * max(train.rays_per_batch, train.probe_rays)
    return max(0, left // _gaussian_bytes(train.sh_degree))


def model_bytes(photographs: int) -> int:
    """Return the memory that the model of so many photographs takes while it is read."""
    return _MODEL_BYTES_PER_PHOTOGRAPH * photographs


def _pose_search_cpu_seconds(photographs: Sequence[ImageSizes]) -> tuple[dict[str, float], dict[str, float]]:
    """Return the time to find the poses of photographs by stage, if one search places them all.

    The second is what of it runs on one core.
    """
    shrunk = [capped_sizes(sizes, MAX_IMAGE_SIDE_PX) for sizes in photographs]
    count = sum(sizes.count for sizes in shrunk)
    pixels = sum(sizes.width_px * sizes.height_px * sizes.count for sizes in shrunk)
    full_pixels = sum(sizes.width_px * sizes.height_px * sizes.count for sizes in photographs)
    importing = _IMPORT_CPU_SECONDS_PER_PIXEL * full_pixels
    reading = _READ_CPU_SECONDS_PER_PIXEL * full_pixels + importing
    looks, pairs = DEFAULT_CONFIG.expected_pairs(count)
    looking = _PRESELECT_CPU_SECONDS_PER_PAIR * looks
    if DEFAULT_CONFIG.is_large(count):
        decoding = _DECODE_CPU_SECONDS_PER_PIXEL * full_pixels
        mapping = _LARGE_MAP_CPU_SECONDS_PER_PHOTOGRAPH * count
        features = _LARGE_FEATURES_CPU_SECONDS_PER_PIXEL * pixels + decoding
        matches = _LARGE_MATCH_CPU_SECONDS_PER_PAIR * pairs + looking
    else:
        mapping = _MAP_CPU_SECONDS_PER_PHOTOGRAPH * count
        features = _FEATURES_CPU_SECONDS_PER_PIXEL * pixels
        matches = _MATCH_CPU_SECONDS_PER_PAIR * pairs + looking
    stages = {"read": reading, "features": features, "matches": matches, "poses": mapping}
    return stages, {"read": importing, "poses": mapping}


def _export_cpu_seconds(options: ReconstructionConfig, gaussians: int) -> float:
    """Return the time to write the files besides the scene."""
    names = set(options.exports)
    seconds = _SURFACE_CPU_SECONDS if SURFACE_GLB.name in names else 0.0
    return seconds + (_EXPORT_CPU_SECONDS_PER_GAUSSIAN * gaussians if names - {SURFACE_GLB.name} else 0.0)


def reconstruction_bytes(options: ReconstructionConfig, photographs: Sequence[ImageSizes]) -> int:
    """Return the minimal size of a reconstruction's folder: decoded photographs and one checkpoint."""
    shrunk = [capped_sizes(sizes, options.max_side) for sizes in photographs]
    pixels = sum(sizes.width_px * sizes.height_px * sizes.count for sizes in shrunk)
    gaussians = _expected_gaussians(options.train, training_pixels(options, photographs))
    return _CACHED_PIXEL_BYTES * pixels + _checkpoint_bytes(options.train.sh_degree) * gaussians


def image_bytes(options: PictureOptions, photographs: Sequence[ImageSizes], turns: int = 1) -> int:
    """Return the minimal size of a render's images, for each of ``turns`` environments."""
    return round(_IMAGE_PIXEL_BYTES[options.format] * rendered_pixels(options, photographs) * turns)


def _max_image_bytes(disk_bytes: int, image_format: str) -> int:
    """Return the most that images take of which ``disk_bytes`` is the least."""
    return round(disk_bytes * _MAX_IMAGE_PIXEL_BYTES[image_format] / _IMAGE_PIXEL_BYTES[image_format])


def training_pixels(options: ReconstructionConfig, photographs: Sequence[ImageSizes]) -> int:
    """Return the pixels of a reconstruction's training views, if all photographs have poses."""
    shrunk = [capped_sizes(sizes, options.max_side) for sizes in photographs]
    count = sum(sizes.count for sizes in shrunk)
    pixels = sum(sizes.width_px * sizes.height_px * sizes.count for sizes in shrunk)
    return round(pixels * (1 - held_out_count(options, count) / max(count, 1)))


def estimate_render(options: RenderOptions, photographs: Sequence[ImageSizes], cores: int) -> Estimate:
    """Return the estimate of new views; for views of photographs, all are counted."""
    pixels = rendered_pixels(options, photographs)
    each = _RENDER_CPU_SECONDS_PER_PIXEL
    if options.stage is not None:
        each += _PATH_CPU_SECONDS * options.stage.integrator.samples
    cpu_seconds = _RENDER_START_CPU_SECONDS + each * pixels
    memory = _render_bytes(options, photographs)
    disk = image_bytes(options, photographs)
    most = _max_image_bytes(disk, options.format)
    return _make_estimate(cpu_seconds, memory, cores, disk_bytes=disk, max_disk_bytes=most)


def estimate_relight(options: RelightOptions, photographs: Sequence[ImageSizes], cores: int) -> Estimate:
    """Return the estimate of relighting; a ray of the split sum counts as a path."""
    each = _PATH_CPU_SECONDS * options.samples_per_pixel * len(options.environments)
    cpu_seconds = _RENDER_START_CPU_SECONDS + each * rendered_pixels(options, photographs)
    memory = _render_bytes(options, photographs)
    disk = image_bytes(options, photographs, len(options.environments))
    most = _max_image_bytes(disk, options.format)
    return _make_estimate(cpu_seconds, memory, cores, disk_bytes=disk, max_disk_bytes=most)


def _render_bytes(options: PictureOptions, photographs: Sequence[ImageSizes]) -> int:
    """Return the memory of a render: a scene of the usual size, and the largest picture."""
    shrunk = [capped_sizes(sizes, options.max_side) for sizes in photographs]
    largest = max((sizes.width_px * sizes.height_px for sizes in shrunk), default=0)
    scene = _START_BYTES + _gaussian_bytes(2) * _TYPICAL_RENDER_GAUSSIANS
    return scene + picture_bytes(options, largest)


def rendered_pixels(options: PictureOptions, photographs: Sequence[ImageSizes]) -> int:
    """Return the largest number of pixels of all images of a render; a preview is one image."""
    is_preview = isinstance(options, RenderOptions) and options.preview
    if options.mode == "path" and options.camera_path is not None:
        path = options.camera_path
        return (1 if is_preview else path.frame_count) * path.width * path.height
    if options.mode != "views":
        return (1 if is_preview else options.frame_count) * options.width_px * options.height_px
    shrunk = [capped_sizes(sizes, options.max_side) for sizes in photographs]
    # which sizes the named photographs have, or the first view, is not known here: the largest
    if is_preview or options.photographs is not None:
        largest = max((sizes.width_px * sizes.height_px for sizes in shrunk), default=0)
        return largest * (1 if is_preview else len(options.photographs or ()))
    return sum(sizes.width_px * sizes.height_px * sizes.count for sizes in shrunk)


def _make_estimate(
    cpu_seconds: float,
    memory_bytes: float,
    cores: int,
    *,
    finds_poses: bool = False,
    disk_bytes: int = 0,
    stages: Mapping[str, float] | None = None,
    serial: Mapping[str, float] | None = None,
    max_disk_bytes: int = 0,
) -> Estimate:
    """Return an estimate from CPU seconds, in all and by stage; those of ``serial`` run on one core."""
    speedup = max(1, cores) ** _CORE_POWER
    # by the clock, on one core takes this much longer
    longer = {name: seconds * (1 - 1 / speedup) for name, seconds in (serial or {}).items()}
    by_stage = {name: seconds / speedup + longer.get(name, 0.0) for name, seconds in (stages or {}).items()}
    return Estimate(
        cpu_seconds=round(cpu_seconds, 1),
        seconds=round(cpu_seconds / speedup + sum(longer.values()), 1),
        cores=max(1, cores),
        memory_bytes=round(memory_bytes),
        finds_poses=finds_poses,
        disk_bytes=disk_bytes,
        stage_seconds={name: round(seconds, 1) for name, seconds in by_stage.items()},
        max_disk_bytes=max_disk_bytes,
    )


def capped_sizes(sizes: ImageSizes, max_side: int | None) -> ImageSizes:
    """Return the sizes of photographs that are shrunk to a longest side."""
    longest = max(sizes.width_px, sizes.height_px)
    if max_side is None or longest <= max_side:
        return sizes
    scale = max_side / longest
    return ImageSizes(
        max(1, round(sizes.width_px * scale)), max(1, round(sizes.height_px * scale)), sizes.count
    )


def held_out_count(options: ReconstructionConfig, count: int) -> int:
    """Return how many of so many photographs are held out."""
    if options.held_out is not None:
        return min(len(options.held_out), count)
    return -(-count // options.test_every) if options.test_every else 0


def _expected_gaussians(train: TrainConfig, trained_on: int) -> int:
    most = max_gaussian_count(train, trained_on)  # as many as allowed: most trainings grow up to the cap
    return min(most, _PAPER_GAUSSIANS) if train.densify.kind == "redisplats" else most


def ray_cost_growth(train: TrainConfig, gaussians: int, seen: int) -> float:
    """Return how many times as long a ray takes where it meets ``seen`` Gaussians and not ``gaussians``."""
    return _ray_cpu_seconds(train, max(seen, 1)) / _ray_cpu_seconds(train, max(gaussians, 1))


def _ray_cpu_seconds(train: TrainConfig, gaussians: int) -> float:
    if train.ray_patch_rays == 1:
        return _SINGLE_RAY_CPU_SECONDS
    near, far = min(gaussians, _FITTED_GAUSSIANS) / 1e5, max(gaussians / _FITTED_GAUSSIANS, 1.0)
    seconds = max(_RAY_CPU_SECONDS * near**_RAY_POWER * far**_FAR_RAY_POWER, _LEAST_RAY_CPU_SECONDS)
    if train.materials.learn:
        lit = float(_MATERIAL_RAY_CPU_SECONDS * (gaussians / _MATERIAL_GAUSSIANS) ** _FAR_RAY_POWER)
        return lit + float(seconds if train.loss.edges else 0)
    saved = _SHARED_SORT_SAVING * train.shared_sort_until if uses_shared_sort(train) else 0.0
    return float(seconds * (1 - saved))


def _gaussian_bytes(sh_degree: int) -> int:
    """Return the bytes per Gaussian: float32 parameters, gradients, two moments and mean, and hierarchy.

    789 for degree 2 were measured before there was that mean, which adds 148.
    """
    return 197 + 20 * (10 + 3 * (sh_degree + 1) ** 2)


def _checkpoint_bytes(sh_degree: int) -> int:
    """Return the bytes per Gaussian of float32 parameters and two moments."""
    return 12 * (10 + 3 * (sh_degree + 1) ** 2)
