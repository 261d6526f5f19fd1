"""Datasets with their pixels: rays and colors of any pixels of any views."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32, Int, Int64

from octasplat.engine.core.local_origin import NO_ORIGIN, Origin
from octasplat.engine.core.rays import ImageRays, RayBatch
from octasplat.engine.dataset.camera import Camera
from octasplat.engine.dataset.camera_clearance import camera_clearances
from octasplat.engine.dataset.depth_maps import (
    DepthMaps,
    check_geometry,
    depth_maps_digest,
    fit_unit,
    open_depth_maps,
)
from octasplat.engine.dataset.image_info import ImageInfo, Storage
from octasplat.engine.dataset.images import ValueScale
from octasplat.engine.dataset.kernels import gather
from octasplat.engine.dataset.known_geometry import KnownGeometry
from octasplat.engine.dataset.load import load_dataset_model, require_masks
from octasplat.engine.dataset.model import DatasetModel, DatasetView, Observations, SparsePoints, Viewpoints
from octasplat.engine.dataset.pixel_cache import PixelCache, file_digests, open_pixel_cache
from octasplat.engine.dataset.ray_tables import (
    MAX_TABLE_BYTES,
    RayTables,
    iterate_row_blocks,
    open_ray_tables,
)
from octasplat.engine.dataset.region import Region, region_pixels
from octasplat.engine.dataset.scene_split import SceneSplit, SplitRule, SplitSource, split_scene
from octasplat.engine.dataset.split import evaluation_split
from octasplat.engine.dataset.training_points import training_points
from octasplat.engine.dataset.view_rays import ViewRays, as_int64, raise_for_pixels
from octasplat.engine.dataset.view_tiles import Rectangles
from octasplat.engine.dataset.views_file import ViewsRecord, views_record

MaskUse = Literal["ignore", "alpha"]

MIN_AXIS_COSINE = 0.05
"""Depths along the axis tell nothing of rays farther from it than this cosine."""
NEAR_FROM_POINTS = 0.25
"""Most that the near distance may be of the distance at which things begin.

Along a wall 2 m away, the path of 400 photographs a metre apart has an extent of which 1 % is 2 m.
"""


class Dataset:
    """Photographs with poses, ready to train on; pixels stay on disk and are mapped into memory.

    Colors are straight display values; world coordinates are COLMAP's. Every method that takes pixels takes
    three arrays: the view, the row ``y`` and the column ``x`` of each pixel.

    Attributes:
        root: folder of the scene.
        views: all views, sorted by name.
        cameras: cameras at the working size.
        points: sparse points that the training views know, see
            :mod:`octasplat.engine.dataset.training_points`; all of them where all views are held out.
        observations: of all sparse points.
        train_indices: views to train on.
        test_indices: views held out.
        views_record: what the photographs and their model are, to be compared with those of another time.
        origin_world: where all of it has its origin in the coordinates of the files, see
            :mod:`octasplat.engine.core.local_origin`.
        warnings: one sentence each on what is odd but usable.
        region: the box that is trained in detail; None where all of the scene is.
        trained_pixels: how often each pixel is drawn where there is a region; None stands for evenly.
        has_alpha: whether any pixel can have an alpha below 1.
        has_masks: whether any view has a mask.
        has_stored_alpha: whether the alpha of any photograph is below 1 anywhere, whatever masks say.
        image_infos: headers of the photographs.
        value_scales: see :mod:`octasplat.engine.dataset.value_scale`.
        depth_maps: None where there are none.
        has_known_distances: whether any view has a depth map, or geometry is known.
        extent: radius of the training cameras, see :func:`octasplat.engine.dataset.model.scene_extent`.
        near_world: distance from the cameras at which anything is seen: ``near`` of the extent, but at most
            :data:`NEAR_FROM_POINTS` of the least distance at which the sparse points around a training camera
            begin; where it is given, all views are held out.
    """

    def __init__(
        self,
        model: DatasetModel,
        cache: PixelCache,
        tables: RayTables,
        *,
        split: SceneSplit | None = None,
        masks: MaskUse = "ignore",
        near: float = 0.0,
        near_world: float | None = None,
        region: Region | None = None,
        depth_maps: DepthMaps | None = None,
        depths_sha256: str | None = None,
    ) -> None:
        self.root: Path = model.root
        self.views: tuple[DatasetView, ...] = model.views
        self.cameras: tuple[Camera, ...] = model.cameras
        self.origin_world: Origin = model.origin_world
        self.warnings: list[str] = [*model.warnings, *cache.warnings]
        self.train_indices: Int64[np.ndarray, " train"]
        self.test_indices: Int64[np.ndarray, " test"]
        names = [view.name for view in model.views]
        split = SceneSplit(*evaluation_split(names)) if split is None else split
        self.train_indices, self.test_indices = split.train_indices, split.test_indices
        self.warnings += split.warnings
        self.points: SparsePoints = (
            training_points(self.train_indices, model.points, model.observations)
            if len(self.train_indices)
            else model.points
        )
        self.observations: Observations = model.observations
        self.views_record: ViewsRecord = views_record(model, cache.digests, self.test_indices, depths_sha256)
        self.depth_maps: DepthMaps | None = depth_maps
        self._axes_world = np.stack([view.rotation_cam_from_world[2] for view in model.views])
        self.has_known_distances: bool = depth_maps is not None
        self.has_masks: bool = len(cache.mask.values) > 0
        self._mask_is_alpha = masks == "alpha"
        self.has_stored_alpha: bool = len(cache.alpha.values) > 0
        self.has_alpha: bool = self.has_stored_alpha or (self._mask_is_alpha and self.has_masks)
        self.image_infos: tuple[ImageInfo, ...] = model.image_infos
        self.value_scales: Mapping[Storage, ValueScale] = cache.scales
        self._cache = cache
        self._view_rays = ViewRays(model, tables)
        self.warnings += self._view_rays.warnings
        self.extent: float = self.views_record.extent_world
        self.near_world: float = self._near_distances(near) if near_world is None else near_world
        self._train_pixels: Int64[np.ndarray, " train"] = np.cumsum(
            self._view_rays.sizes[self.train_indices].prod(axis=1)
        )
        self.region = None if region is None else region.with_origin(self.origin_world)
        self.trained_pixels: Rectangles | None = None
        if self.region is not None:
            self.trained_pixels = region_pixels(
                self._view_rays.sizes, self.train_indices, self.rays, self.region
            )

    @classmethod
    def open(
        cls,
        root: Path,
        cache_dir: Path,
        *,
        max_side: int | None = None,
        test_every: int = 8,
        held_out: Sequence[str] | None = None,
        masks: MaskUse = "ignore",
        model_folder: Path | None = None,
        check_views: Callable[[ViewsRecord], None] | None = None,
        near: float = 0.0,
        threads: int = 0,
        progress: Callable[[int, int], None] | None = None,
        max_table_bytes: int = MAX_TABLE_BYTES,
        origin_world: Origin | None = None,
        burst_length: int = 1,
        split: SplitSource = "given",
        stored_split: Mapping[str, bool] | None = None,
        model: str | None = None,
        region: Region | None = None,
        depth_unit: float | None = None,
        geometry: KnownGeometry | None = None,
    ) -> "Dataset":
        """Load a scene and decode its photographs into ``cache_dir``, or reuse those already cached there.

        Args:
            root: folder with ``images/``, a COLMAP model in ``sparse/0``, ``sparse`` or ``colmap/sparse/0``
                and, if there are any, ``masks/<image name>.png`` (white = valid).
            cache_dir: folder of the cache, about 3 bytes per pixel (6 if a photograph has more than 8 bits).
            max_side: cap on the longer side of the photographs, in pixels.
            test_every: hold out every N-th view in name order, starting with the first; 0 holds out none.
            held_out: names of the views to hold out instead.
            masks: ``ignore`` gives pixels outside the mask the weight 0; ``alpha`` multiplies the mask into
                alpha, for an object on a transparent background.
            model_folder: where the COLMAP model is, if not in ``root``.
            check_views: called with the record of the views before any photograph is decoded; raises to
                reject the dataset.
            near: distance of the near plane as a fraction of the scene extent; nothing nearer is seen.
            threads: decoding threads; 0 takes one per processor.
            progress: called with (photographs done, total) while decoding.
            max_table_bytes: limit on the ray tables of non-pinhole cameras.
            origin_world: world position to use as the local origin; None chooses one for large coordinates.
            burst_length: so many views that follow each other by name fall on one side of the split.
            split: ``given`` holds out what the scene says, if it does; ``every`` does not ask it.
            stored_split: whether each view is held out by the run that goes on, see :class:`SplitRule`.
            model: which of several models of the scene to take, by its path below it or its number.
            region: the box to train in detail; None trains all of the scene alike.
            depth_unit: world units for one unit of the depth maps' values, see
                :mod:`octasplat.engine.dataset.depth_maps`; None finds it by the sparse points.
            geometry: a mesh or cloud of points that is known of the scene.

        Raises:
            DatasetError: something is missing, damaged or inconsistent.
            OutputError: the cache cannot be written.
            ConfigError: a setting is out of range.
        """
        scene = load_dataset_model(
            root, max_side=max_side, model_folder=model_folder, model=model, origin_world=origin_world
        )
        if masks == "alpha":
            require_masks(scene)
        # Fail before the expensive decoding.
        rule = SplitRule(test_every, held_out, burst_length, split, stored_split)
        parts = split_scene(scene, rule)
        digests, depths_sha256, depth_maps = None, depth_maps_digest(scene, geometry), None
        if check_views is not None:
            digests = file_digests(scene, cache_dir, threads=threads)
            check_views(views_record(scene, digests, parts.test_indices, depths_sha256))
        if depths_sha256 is not None:
            depth_maps = open_depth_maps(
                scene, cache_dir, depths_sha256, unit_world=depth_unit, threads=threads, geometry=geometry
            )
            notes = []
            if depth_unit is None and any(view.depth_path is not None for view in scene.views):
                depth_maps, note = fit_unit(depth_maps, scene, parts.train_indices)
                notes.append(note)
            if geometry is not None:
                notes.append(check_geometry(depth_maps, scene, parts.train_indices, geometry))
            scene = replace(scene, warnings=(*scene.warnings, *notes))
        cache = open_pixel_cache(scene, cache_dir, digests, threads=threads, progress=progress)
        tables = open_ray_tables(scene.cameras, cache_dir, max_table_bytes)
        return cls(
            scene, cache, tables, split=parts, masks=masks, near=near, region=region,
            depth_maps=depth_maps, depths_sha256=depths_sha256,
        )  # fmt: skip

    @classmethod
    def open_for_evaluation(
        cls,
        root: Path,
        cache_dir: Path,
        *,
        near_world: float,
        origin_world: Origin = NO_ORIGIN,
        max_side: int | None = None,
        masks: MaskUse = "ignore",
        model_folder: Path | None = None,
        model: str | None = None,
        threads: int = 0,
        progress: Callable[[int, int], None] | None = None,
    ) -> "Dataset":
        """Open photographs that only evaluate a scene trained on others: all are held out, one is enough.

        Args:
            root: as in :meth:`open`; the model needs no points.
            cache_dir: folder of the cache.
            near_world: distance of the near plane, that of the scene.
            origin_world: local origin of the scene.
            max_side: cap on the longer side of the photographs, in pixels.
            masks: as in :meth:`open`.
            model_folder: as in :meth:`open`.
            model: as in :meth:`open`.
            threads: decoding threads; 0 takes one per processor.
            progress: called with (photographs done, total) while decoding.

        Raises:
            DatasetError: something is missing, damaged or inconsistent.
            OutputError: the cache cannot be written.
        """
        scene = load_dataset_model(
            root, max_side=max_side, model_folder=model_folder, model=model, min_views=1, for_training=False,
            origin_world=origin_world,
        )  # fmt: skip
        if masks == "alpha":
            require_masks(scene)
        cache = open_pixel_cache(scene, cache_dir, threads=threads, progress=progress)
        tables = open_ray_tables(scene.cameras, cache_dir, MAX_TABLE_BYTES)
        return cls(scene, cache, tables, masks=masks, near_world=near_world)

    def _near_distances(self, near: float) -> float:
        nearest = camera_clearances(self.viewpoints, self.points)[self.train_indices]
        known = nearest[nearest > 0]
        cap = NEAR_FROM_POINTS * float(known.min()) if len(known) else np.inf
        return float(min(near * self.extent, cap))

    @property
    def viewpoints(self) -> Viewpoints:
        """Return the poses and cameras of all views."""
        return Viewpoints(self.views, self.cameras)

    @property
    def train_pixel_count(self) -> int:
        """Return the number of pixels of all training views, including those of weight 0.

        Where there is a region, pixels that are drawn less often count less.
        """
        if self.trained_pixels is not None:
            return self.trained_pixels.of_views(self.train_indices).drawn_pixel_count
        return int(self._train_pixels[-1])

    def rays(
        self, view: Int[np.ndarray, " n"], y: Int[np.ndarray, " n"], x: Int[np.ndarray, " n"]
    ) -> RayBatch:
        """Return the unit rays through pixel centres.

        A pixel that its camera model cannot un-project looks along the axis of the camera; :meth:`pixels`
        gives it the weight 0.

        Raises:
            IndexError: a pixel does not exist.
        """
        origins, directions = self._view_rays.trace(view, y, x)
        return RayBatch(origins, directions, self.near_world)

    def pixels(
        self, view: Int[np.ndarray, " n"], y: Int[np.ndarray, " n"], x: Int[np.ndarray, " n"]
    ) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
        """Return straight display colors and alpha in [0, 1], and weights: 1, or 0 for invalid pixels.

        Raises:
            IndexError: a pixel does not exist, or was not opened.
        """
        view, y, x = as_int64(view), as_int64(y), as_int64(x)
        self._cache.require(view)
        rgb = np.empty((len(view), 3), dtype=np.float32)
        alpha = np.empty(len(view), dtype=np.float32)
        weight = np.empty(len(view), dtype=np.float32)
        values = self._cache.rgb.values
        bad = gather.gather_pixels(
            gather.PixelIndices(view, y, x), self._view_rays.arrays,
            gather.PixelPlanes(
                self._cache.offsets, values, np.float32(np.iinfo(values.dtype).max),
                self._cache.alpha.values, self._cache.mask.values, self._mask_is_alpha,
            ),
            rgb, alpha, weight,
        )  # fmt: skip
        raise_for_pixels(bad, view, y, x)
        weight[self._view_rays.invalid_rays(view, y, x)] = 0.0
        return rgb, alpha, weight

    def known_distances(
        self, view: Int[np.ndarray, " n"], y: Int[np.ndarray, " n"], x: Int[np.ndarray, " n"]
    ) -> Float32[np.ndarray, " n"]:
        """Return distances of the surface along the rays of pixels by depth maps, world units; 0 if unknown.

        Raises:
            IndexError: a pixel does not exist.
        """
        if self.depth_maps is None:
            return np.zeros(len(view), np.float32)
        view, y, x = as_int64(view), as_int64(y), as_int64(x)
        depth = self.depth_maps.z_world(view, y, x, self._view_rays.sizes)
        _, directions = self._view_rays.trace(view, y, x)
        along = np.einsum("nk,nk->n", directions, self._axes_world[view])
        # pixels of weight 0 and rays beside or behind the plane of the camera know nothing
        known = (depth > 0) & (along > MIN_AXIS_COSINE) & ~self._view_rays.invalid_rays(view, y, x)
        return np.divide(depth, along, out=np.zeros(len(view)), where=known).astype(np.float32)

    def view_rays(self, view_index: int) -> ImageRays:
        """Return all rays of one view."""
        width, height = self._view_size(view_index)
        directions = np.empty((height * width, 3), dtype=np.float32)
        for pixels, view, y, x in iterate_row_blocks(view_index, width, height):
            directions[pixels] = self.rays(view, y, x).directions_world
        return ImageRays(
            RayBatch(self._view_rays.origins_world[[view_index]], directions, self.near_world), height, width
        )

    def view_image(
        self, view_index: int
    ) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
        """Return colors, alpha and weights of all pixels of one view, as by :meth:`pixels`."""
        width, height = self._view_size(view_index)
        rgb = np.empty((height * width, 3), dtype=np.float32)
        alpha = np.empty(height * width, dtype=np.float32)
        weight = np.empty(height * width, dtype=np.float32)
        for pixels, view, y, x in iterate_row_blocks(view_index, width, height):
            rgb[pixels], alpha[pixels], weight[pixels] = self.pixels(view, y, x)
        return rgb.reshape(height, width, 3), alpha.reshape(height, width), weight.reshape(height, width)

    def sample_pixels(
        self, rng: np.random.Generator, count: int
    ) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
        """Draw ``count`` pixels (view, y, x), uniformly and independently over all training views."""
        drawn = rng.integers(0, self._train_pixels[-1], size=count, dtype=np.int64)
        # "right": a number that equals the end of one view is the first pixel of the next.
        which = np.searchsorted(self._train_pixels, drawn, side="right")
        view = self.train_indices[which]
        width = self._view_rays.sizes[view, 0]
        inside = drawn - (self._train_pixels[which] - width * self._view_rays.sizes[view, 1])
        y = inside // width
        return view, y, inside - y * width

    def read_ahead(self, views: Int64[np.ndarray, " n"]) -> None:
        """Read the pixels of views that are needed next, if they take less than half of the memory."""
        starts, ends = self._cache.offsets[:-1][views], self._cache.offsets[1:][views]
        ranges = np.stack([starts, ends], axis=1)
        for mapped, channels in ((self._cache.rgb, 3), (self._cache.alpha, 1), (self._cache.mask, 1)):
            mapped.read_ahead(channels * ranges)

    def release_pages(self) -> None:
        """Release mapped pages to the system, e.g. before a stage that needs the memory."""
        for mapped in (self._cache.rgb, self._cache.alpha, self._cache.mask):
            mapped.release()
        if self.depth_maps is not None:
            self.depth_maps.values.release()
        self._view_rays.release_pages()

    def _view_size(self, view_index: int) -> tuple[int, int]:
        if not 0 <= view_index < len(self.views):
            raise IndexError(f"there is no view {view_index} among {len(self.views)}")
        return self.views[view_index].width_px, self.views[view_index].height_px
