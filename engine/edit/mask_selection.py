"""Selection of Gaussians by masks of photographs."""

from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Bool, Int64

from octasplat.engine.core.errors import ConfigError, DatasetError
from octasplat.engine.core.rays import ImageRays
from octasplat.engine.dataset.model import Viewpoints
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.image_files import read_image
from octasplat.engine.render.renderer import tile_order
from octasplat.engine.render.shots import view_shots
from octasplat.engine.runs.config import read_config
from octasplat.engine.runs.run_folder import CONFIG, is_full_run, run_min_view_distance, run_viewpoints
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import Tracer
from octasplat.engine.trace.weight_sums import blend_weight_sums

MASK_THRESHOLD = 0.5


def select_by_masks(
    source: Path, gaussians: FlatGaussians, masks: Sequence[Path], *, threads: int = 0
) -> Bool[np.ndarray, " n"]:
    """Return a mask of a run's Gaussians that are visible where masks of its photographs are white.

    Args:
        source: folder of the run.
        gaussians: its scene.
        masks: images of any size with the names of photographs, as ``0001.png`` or ``0001.jpg.png``; in
            folders as the photographs are, where their file names alone do not tell them apart.
        threads: to use; 0 takes all.

    Raises:
        ConfigError: the source is no run, or an image is no mask of its photographs.
    """
    if not is_full_run(source):
        raise ConfigError(f"{source}: masks need the folder of a run, which knows its cameras.")
    config, viewpoints = read_config(source / CONFIG), run_viewpoints(source)
    near_world = run_min_view_distance(source, viewpoints)
    tracer = make_tracer(config.train.trace, threads=threads)
    tracer.build(gaussians)
    views = ((_rays_of_masked_view(viewpoints, path, near_world), path) for path in masks)
    return mostly_inside(
        tracer, len(gaussians), ((rays, _mask_at_pixels(path, rays)) for rays, path in views)
    )


def mostly_inside(
    tracer: Tracer, count: int, views: Iterable[tuple[ImageRays, Bool[np.ndarray, "h w"]]]
) -> Bool[np.ndarray, " n"]:
    """Return the Gaussians whose blending weight inside masks exceeds that outside, over all views.

    Args:
        tracer: with the scene built.
        count: number of its Gaussians.
        views: rays through pixels, and which pixels are meant.
    """
    inside, outside = np.zeros(count), np.zeros(count)
    for image, mask in views:
        order = tile_order(image.height_px, image.width_px)
        meant = mask.ravel()[order]
        inside += blend_weight_sums(tracer, image.rays[order[meant]], count)
        outside += blend_weight_sums(tracer, image.rays[order[~meant]], count)
    return np.asarray(inside > outside)


def _rays_of_masked_view(viewpoints: Viewpoints, path: Path, near_world: float) -> ImageRays:
    number = photograph_of_mask(path, [view.name for view in viewpoints.views])
    return view_shots(viewpoints, np.array([number]), near_world)[0].rays()


def photograph_of_mask(mask: Path, photographs: Sequence[str]) -> int:
    """Return the number of the photograph that a mask is of.

    Args:
        mask: its path ends in the photograph's relative path, with ``.png`` added or another suffix. Where
            that is so of several, the longest counts; where it is of none, the one of this file name.
        photographs: relative paths.

    Raises:
        ConfigError: none has this name, or several have.
    """
    parts = mask.parts
    same_file: list[int] = []
    same_path: list[tuple[int, int]] = []
    for number, name in enumerate(photographs):
        for candidate in {PurePosixPath(f"{name}.png"), PurePosixPath(name).with_suffix(mask.suffix)}:
            if candidate.name == mask.name:
                same_file.append(number)
                if parts[-len(candidate.parts) :] == candidate.parts:
                    same_path.append((len(candidate.parts), number))
    longest = max((length for length, _ in same_path), default=0)
    found = sorted({number for length, number in same_path if length == longest} or set(same_file))
    if not found:
        raise ConfigError(f"{mask}: the run has no photograph of this name.")
    if len(found) > 1:
        names = " and ".join(photographs[number] for number in found[:2])
        raise ConfigError(
            f"{mask}: may be a mask of {names}; name it as its photograph is named with .png added, in a "
            "folder of the photograph's."
        )
    return found[0]


def _mask_at_pixels(path: Path, image: ImageRays) -> Bool[np.ndarray, "h w"]:
    """Return which pixels of an image of rays lie where a mask is white."""
    try:
        mask = read_image(path)[..., 0]
    except DatasetError as error:
        raise ConfigError(f"{path}: the mask cannot be read: {error}") from None
    rows, columns = (
        _resampled_centres(size, there)
        for size, there in zip(mask.shape, (image.height_px, image.width_px), strict=True)
    )
    return np.asarray(mask[np.ix_(rows, columns)] > MASK_THRESHOLD)


def _resampled_centres(size: int, there: int) -> Int64[np.ndarray, " p"]:
    """Return the positions, in a row of ``size`` pixels, of the centres of ``there`` pixels."""
    return ((np.arange(there) + 0.5) * size / there).astype(np.int64)
