"""Some of the photographs of a scene, opened without the others as they are opened with them.

Files of the other photographs, masks and depth maps need only their names, and may be empty.
"""

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from octasplat.engine.core.errors import CheckpointError
from octasplat.engine.dataset.dataset import Dataset, MaskUse
from octasplat.engine.dataset.depth_maps import DepthMaps, open_depth_maps
from octasplat.engine.dataset.images import ValueScale
from octasplat.engine.dataset.known_geometry import KnownGeometry
from octasplat.engine.dataset.load import load_dataset_model
from octasplat.engine.dataset.model import DatasetModel, DatasetView
from octasplat.engine.dataset.photograph_facts import PhotographFacts, ViewFiles
from octasplat.engine.dataset.pixel_cache import CacheForm, PixelCache, file_digests, open_pixel_cache
from octasplat.engine.dataset.ray_tables import MAX_TABLE_BYTES, open_ray_tables
from octasplat.engine.dataset.scene_split import SceneSplit
from octasplat.engine.dataset.views_file import FileDigests, ViewsRecord, views_record


def photograph_facts(dataset: Dataset) -> PhotographFacts:
    """Return what :func:`open_dataset_part` needs of all photographs, which are open."""
    maps = dataset.depth_maps
    return PhotographFacts(
        files=tuple(_files_of_view(view, dataset.root) for view in dataset.views),
        infos=dataset.image_infos,
        scales={name: (scale.full, scale.is_display) for name, scale in dataset.value_scales.items()},
        has_alpha=dataset.has_stored_alpha,
        depth_units_world=None if maps is None else tuple(maps.unit_world.tolist()),
        have_depths=() if maps is None else tuple(maps.have_depths.tolist()),
    )


def open_dataset_part(
    root: Path,
    cache_dir: Path,
    views: Int64[np.ndarray, " w"],
    facts: PhotographFacts,
    recorded: ViewsRecord,
    *,
    max_side: int | None = None,
    masks: MaskUse = "ignore",
    model_folder: Path | None = None,
    model: str | None = None,
    near: float = 0.0,
    geometry: KnownGeometry | None = None,
    check_views: Callable[[ViewsRecord], None] | None = None,
    threads: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Dataset:
    """Open a scene of which only the pixels of some views can be asked for.

    All else is as :meth:`Dataset.open` has it, poses and rays of all views included. Depths of other views
    are unknown.

    Args:
        root: folder of the scene.
        cache_dir: folder of the cache, which only holds those views.
        views: indices of the views, ascending.
        facts: on all photographs.
        recorded: the views of the run, which decide the split.
        max_side: as in :meth:`Dataset.open`, like all that follow.
        masks: likewise.
        model_folder: likewise.
        model: likewise.
        near: likewise.
        geometry: likewise.
        check_views: likewise; digests of other views are those recorded.
        threads: likewise.
        progress: likewise.

    Raises:
        DatasetError: something is missing, damaged or inconsistent.
        CheckpointError: the scene has other photographs than the facts are on.
        OutputError: the cache cannot be written.
    """
    infos = {root / files[0]: info for files, info in zip(facts.files, facts.infos, strict=True)}
    scene = load_dataset_model(
        root, max_side=max_side, model_folder=model_folder, model=model, origin_world=recorded.origin_world,
        infos=infos,
    )  # fmt: skip
    names = [view.name for view in scene.views]
    rows = {row.name: row for row in recorded.views}
    if tuple(_files_of_view(view, root) for view in scene.views) != facts.files or rows.keys() != set(names):
        raise CheckpointError(f"{root} has other photographs than the run was begun with.")
    part = replace(
        scene,
        views=tuple(scene.views[index] for index in views),
        image_infos=tuple(scene.image_infos[index] for index in views),
    )
    digests = [FileDigests(rows[name].photograph_sha256, rows[name].mask_sha256) for name in names]
    own = file_digests(part, cache_dir, threads=threads)
    for index, found in zip(views.tolist(), own, strict=True):
        digests[index] = found
    is_test = np.array([rows[name].held_out for name in names], bool)
    split = SceneSplit(np.flatnonzero(~is_test), np.flatnonzero(is_test))
    if check_views is not None:
        check_views(views_record(scene, digests, split.test_indices, recorded.depths_sha256))
    form = CacheForm(
        bits=max(info.bits for info in facts.infos),
        has_alpha=facts.has_alpha,
        has_masks=any(view.mask_path is not None for view in scene.views),
        scales={name: ValueScale(*scale) for name, scale in facts.scales.items()},
    )
    cache = open_pixel_cache(part, cache_dir, own, threads=threads, progress=progress, form=form)
    depth_maps = None
    if recorded.depths_sha256 is not None and facts.depth_units_world is not None:
        digest = hashlib.sha256(repr((recorded.depths_sha256, views.tolist())).encode()).hexdigest()
        of_part = open_depth_maps(part, cache_dir, digest, threads=threads, geometry=geometry)
        depth_maps = _depths_among_all(of_part, scene, views, facts)
    tables = open_ray_tables(scene.cameras, cache_dir, MAX_TABLE_BYTES)
    return Dataset(
        scene, _pixels_among_all(cache, views, digests), tables,
        split=split, masks=masks, near=near, depth_maps=depth_maps, depths_sha256=recorded.depths_sha256,
    )  # fmt: skip


def _files_of_view(view: DatasetView, root: Path) -> ViewFiles:
    def below(path: Path | None) -> str | None:
        return None if path is None else path.relative_to(root).as_posix()

    return view.image_path.relative_to(root).as_posix(), below(view.mask_path), below(view.depth_path)


def _ends_among_all(
    counts: Int64[np.ndarray, " w"], views: Int64[np.ndarray, " w"], count: int
) -> Int64[np.ndarray, " views_and_end"]:
    """Return the first place of every view, and the end, where only some of ``count`` views have places."""
    sizes = np.zeros(count, np.int64)
    sizes[views] = counts
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)


def _pixels_among_all(
    cache: PixelCache, views: Int64[np.ndarray, " w"], digests: list[FileDigests]
) -> PixelCache:
    """Return the cache of some views as one of all views, most of which have no pixels."""
    offsets = _ends_among_all(np.diff(cache.offsets), views, len(digests))
    return replace(cache, offsets=offsets, digests=tuple(digests), is_partial=len(views) < len(digests))


def _depths_among_all(
    maps: DepthMaps, model: DatasetModel, views: Int64[np.ndarray, " w"], facts: PhotographFacts
) -> DepthMaps:
    """Return the depth maps of some views as those of all views, in the units that all of them have."""
    count = len(model.views)
    sizes_px = np.zeros((count, 2), np.int64)
    sizes_px[views] = maps.sizes_px
    of_geometry = np.zeros(count, bool)
    of_geometry[views] = maps.are_of_geometry
    return replace(
        maps,
        offsets=_ends_among_all(np.diff(maps.offsets), views, count),
        sizes_px=sizes_px,
        unit_world=np.array(facts.depth_units_world, np.float64),
        are_of_geometry=of_geometry,
        have_depths=np.array(facts.have_depths, bool),
    )
