"""Inputs of ``surface``: cameras, and the photographs of a run."""

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from octasplat.engine.core.color import to_bytes
from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.events import EventListener, Noted, Warned
from octasplat.engine.core.rays import ImageRays
from octasplat.engine.dataset import Dataset, load_dataset_model
from octasplat.engine.dataset.views_file import ViewsRecord, read_views
from octasplat.engine.files import read_metadata
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.engine.runs.config import read_config
from octasplat.engine.runs.run_dataset import open_run_dataset
from octasplat.engine.runs.run_folder import (
    CONFIG,
    VIEWS,
    is_run,
    model_of_photographs,
    photographs_folder,
    run_exposures,
    run_min_view_distance,
    run_viewpoints,
)
from octasplat.engine.shading.exposure import ExposureModel
from octasplat.engine.surface.color_fit import Picture
from octasplat.engine.surface.depth_cameras import cameras_around, photograph_cameras
from octasplat.engine.trace.protocol import TraceSettings


def depth_cameras(
    source: Path, dataset: Path | None, gaussians: FlatGaussians, side_px: int
) -> tuple[tuple[PinholeCamera, ...], TraceSettings]:
    """Return the cameras to render depth from, and the settings of the tracer.

    Args:
        source: the folder of a run, or a file of Gaussians.
        dataset: a folder of photographs whose cameras to take; None takes those that a run keeps, or for a
            file cameras all around.
        gaussians: the scene.
        side_px: longer side of the views.

    Raises:
        ConfigError: the run's settings cannot be read.
        DatasetError: the photographs cannot be used.
    """
    if is_run(source) and (source / CONFIG).exists():
        viewpoints = run_viewpoints(source, scene=dataset)
        settings = read_config(source / CONFIG).train.trace
        near_world = run_min_view_distance(source, viewpoints)
        return photograph_cameras(viewpoints, viewpoints.train_indices, side_px, near_world), settings
    facts = read_metadata(source)
    settings = TraceSettings(flip_normal_cos=facts.turned_beyond)
    if dataset is not None:
        photographs = load_dataset_model(dataset, origin_world=facts.origin_world)
        every = np.arange(len(photographs.views))
        return photograph_cameras(photographs, every, side_px, facts.near_world), settings
    return cameras_around(gaussians, side_px), settings


def training_photographs(
    source: Path, dataset: Path | None, threads: int, progress: EventListener, *, copy: Path | None = None
) -> tuple[Picture, ...]:
    """Return the training photographs of a run, normalised to the scene's exposure.

    Args:
        source: the folder of a run, or a file of Gaussians, which has none.
        dataset: the folder of the photographs; None takes the one that the run was made from.
        threads: for decoding; 0 takes all cores.
        progress: receives the progress events, and why there are none.
        copy: another folder of the photographs that the run was made from.

    Returns:
        None of them where they show reflections that the surface does not, or where none were named and those
        of the run are not on this machine, cannot be read, or have other poses than the scene was made with.

    Raises:
        DatasetError: those that were named cannot be read, or have other poses.
        OutputError: there is no room to decode them.
    """
    if not (is_run(source) and (source / CONFIG).exists()):
        return ()
    config = read_config(source / CONFIG)
    if config.train.materials.learn:  # reflections of the photographs are not on the surface
        return ()
    instead = "Colors are those that the scene shows, not those of photographs"
    try:
        folder = photographs_folder(source, dataset or copy)
        model_folder, model = model_of_photographs(source, folder, config)
    except DatasetError as error:
        progress(Noted(f"{instead}. {error}"))
        return ()
    try:
        # before anything is decoded
        check_views = partial(_check_same_poses, source, folder)
        opened = open_run_dataset(
            folder,
            source,
            config.model_copy(update={"model": model}),
            threads,
            progress,
            model_folder=model_folder,
            check_views=check_views,
        )
    except DatasetError as error:
        if dataset is not None:  # those that were named must fit
            raise
        progress(Warned(f"{instead}. {error}"))
        return ()
    exposures = None
    if (known := run_exposures(source)) is not None:
        exposures = ExposureModel.from_known([view.name for view in opened.views], known)
    return tuple(
        partial(_photograph_rays, opened, exposures, index) for index in opened.train_indices.tolist()
    )


def _check_same_poses(source: Path, folder: Path, found: ViewsRecord) -> None:
    """Check that photographs have the poses that a run was made with, as far as it keeps them.

    Raises:
        DatasetError: they have not.
    """
    if (source / VIEWS).exists() and not read_views(source / VIEWS).is_of_same_world(found):
        raise DatasetError(
            f"{folder} is not what {source} was made from: its photographs have other names or poses; name "
            "the right folder, or use --no-fit to take no colors from them."
        )


def _photograph_rays(
    dataset: Dataset, exposures: ExposureModel | None, index: int
) -> tuple[ImageRays, UInt8[np.ndarray, "h w 4"]]:
    rgb, alpha, weight = dataset.view_image(index)
    if exposures is not None:
        rgb = exposures.remove_exposure(rgb, index)
    solid = (alpha * weight)[..., None]  # premultiplied: what masks leave out has no color
    return dataset.view_rays(index), to_bytes(np.concatenate([rgb * solid, solid], axis=2))
