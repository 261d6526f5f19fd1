"""The photographs of a run, opened with its settings."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from octasplat.engine.core.events import EventListener, Noted, PhaseProgress, Warned
from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.dataset_part import open_dataset_part
from octasplat.engine.dataset.photograph_facts import PhotographFacts
from octasplat.engine.dataset.pixel_cache import has_former_cache
from octasplat.engine.dataset.region import Region
from octasplat.engine.dataset.views_file import ViewsRecord, read_views
from octasplat.engine.runs.config import ReconstructionConfig
from octasplat.engine.runs.geometry_file import find_known_geometry
from octasplat.engine.runs.run_folder import CACHE, VIEWS, found_model_folder, run_origin, stored_split
from octasplat.engine.train.config import min_tile_side_px


def _region(config: ReconstructionConfig) -> Region | None:
    if config.region is None:
        return None
    return Region(config.region, min_tile_side_px(config.train))


def open_run_dataset(
    scene: Path,
    output: Path,
    config: ReconstructionConfig,
    threads: int,
    progress: EventListener,
    *,
    model_folder: Path | None = None,
    check_views: Callable[[ViewsRecord], None] | None = None,
    cache: Path | None = None,
) -> Dataset:
    """Open the photographs of a run with its settings, ready for training or evaluation.

    Args:
        scene: folder of the photographs.
        output: folder of the run, which holds the cache.
        config: of the run.
        threads: for decoding; 0 takes all cores.
        progress: receives the progress events, and what is odd but usable.
        model_folder: of poses that were found, see
            :func:`octasplat.engine.runs.run_folder.found_model_folder`.
        check_views: called with the record of the views before any photograph is decoded; raises to reject
            the dataset.
        cache: folder of the decoded photographs; None takes that of the run.

    Raises:
        DatasetError: the photographs cannot be used.
        OutputError: the cache cannot be written.
    """
    cache = cache or output / CACHE
    if has_former_cache(cache):
        progress(Noted(f"{cache} is of a version with other results, so photographs are decoded again."))
    dataset = Dataset.open(
        scene,
        cache,
        max_side=config.max_side,
        test_every=config.test_every,
        held_out=config.held_out,
        burst_length=config.burst_length,
        split=config.split,
        stored_split=stored_split(output),
        masks=config.masks,
        model_folder=model_folder,
        model=config.model,
        check_views=check_views,
        near=config.train.near,
        origin_world=run_origin(output),
        region=_region(config),
        depth_unit=config.depth_unit,
        geometry=find_known_geometry(scene),
        threads=threads,
        progress=lambda done, total: progress(PhaseProgress("load", done, total)),
    )
    _tell_what_is_odd(dataset, config, progress)
    return dataset


def open_run_part(
    scene: Path,
    output: Path,
    config: ReconstructionConfig,
    threads: int,
    progress: EventListener,
    views: Sequence[int],
    facts: PhotographFacts,
    *,
    check_views: Callable[[ViewsRecord], None] | None = None,
) -> Dataset:
    """Open some of the photographs of a run that goes on; the others need not be there.

    Args:
        scene: folder of the photographs, in which files of the others may be empty.
        output: folder of the run, which holds its views and the cache.
        config: of the run.
        threads: for decoding; 0 takes all cores.
        progress: receives the progress events, and what is odd but usable.
        views: indices of those to open, ascending.
        facts: on all photographs.
        check_views: see :func:`open_run_dataset`.

    Raises:
        DatasetError: the photographs cannot be used.
        CheckpointError: the scene has other photographs than the facts are on.
        OutputError: the cache cannot be written.
    """
    dataset = open_dataset_part(
        scene,
        output / CACHE,
        np.array(views, np.int64),
        facts,
        read_views(output / VIEWS),
        max_side=config.max_side,
        masks=config.masks,
        model_folder=found_model_folder(output),
        model=config.model,
        near=config.train.near,
        geometry=find_known_geometry(scene),
        check_views=check_views,
        threads=threads,
        progress=lambda done, total: progress(PhaseProgress("load", done, total)),
    )
    _tell_what_is_odd(dataset, config, progress)
    return dataset


def _tell_what_is_odd(dataset: Dataset, config: ReconstructionConfig, progress: EventListener) -> None:
    for warning in dataset.warnings:
        progress(Warned(warning))
    if (mismatch := config.background_mismatch(dataset.has_alpha)) is not None:
        progress(Warned(mismatch))
