"""Depth maps beside photographs: which file belongs to which, and how far away a ray's surface is.

A depth map holds for each pixel how far its surface is from the camera along the axis of view (z), as depth
cameras, phones and renderers write it. 0, what is no finite number, and the 1e10 that Blender writes where it
meets nothing, say that nothing is known. A map may be smaller than its photograph, and has the same ratio of
sides and the same lens.

    depths/<name>.png   16-bit: millimetres unless a scale is stated
    depths/<name>.exr   or .tif: floating point; metres unless a scale is stated

Photographs without a map of their own get that of the scene's known geometry, where there is one.

The unit of a scene is that of its poses, which COLMAP chooses at will. Without a stated scale it is found by
the sparse points: their depths in the model over those in the maps.
"""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import TypedDict

import numpy as np
import OpenImageIO as oiio
from jaxtyping import Bool, Float32, Float64, Int64

from octasplat.engine.core import versions
from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.read_ahead import read_ahead
from octasplat.engine.core.relative_paths import normalize_name
from octasplat.engine.core.scene_layout import DEPTH_FOLDERS, IMAGE_SUFFIXES
from octasplat.engine.core.writing import atomic_replace, write_json
from octasplat.engine.dataset.images import open_image, read_pixels
from octasplat.engine.dataset.known_geometry import GeometryDepths, KnownGeometry, digest_with_cameras
from octasplat.engine.dataset.mapped_array import MappedArray
from octasplat.engine.dataset.model import DatasetModel, Viewpoints
from octasplat.engine.dataset.pixel_cache import file_sha256

CACHE_VERSION = 4
"""Raised whenever the contents of the cache file change for the same maps."""
INTEGER_UNIT = 0.001
"""Metres for one unit of integers, as depth cameras store them."""
MAX_STORED = 1e9
"""From this value on nothing is known."""
MIN_POINTS = 50
"""So many observations of sparse points decide the scale."""
GEOMETRY_TOLERANCE = 0.05
"""Share of the depth within which a sparse point lies on the known geometry."""
MIN_AGREEING = 1 / 3
"""So many of the sparse points lie on it; others are on what it does not hold."""
MAX_SPREAD = 0.1
"""Where half of the sparse points are farther off than this share, the maps do not belong to the model."""
_INTEGERS = {oiio.UINT16: "uint16", oiio.INT16: "int16", oiio.UINT32: "uint32", oiio.INT32: "int32"}
_VALUES, _INDEX = "depths.bin", "depths.json"


@dataclass(frozen=True, eq=False)
class DepthMaps:
    """The depth maps of a scene.

    Attributes:
        values: stored values of all maps one after the other, row by row; 0 where nothing is known.
        offsets: first value of each view, and the count of all at the end; views without a map have none.
        sizes_px: width and height of each view's map.
        unit_world: world units for one unit of the stored values, by view.
        are_of_geometry: which of them come from the known geometry, in world units.
        have_depths: which of them hold a depth at all.
    """

    values: MappedArray
    offsets: Int64[np.ndarray, " views_and_end"]
    sizes_px: Int64[np.ndarray, "v 2"]
    unit_world: Float64[np.ndarray, " v"]
    are_of_geometry: Bool[np.ndarray, " v"]
    have_depths: Bool[np.ndarray, " v"]

    def z_world(
        self,
        view: Int64[np.ndarray, " n"],
        y: Int64[np.ndarray, " n"],
        x: Int64[np.ndarray, " n"],
        photograph_sizes_px: Int64[np.ndarray, "v 2"],
    ) -> Float64[np.ndarray, " n"]:
        """Return the depths of pixels along the axis of view, world units; 0 where nothing is known.

        Args:
            view: index of the view of each pixel.
            y: its row.
            x: its column.
            photograph_sizes_px: width and height at which rows and columns count, by view.
        """
        depth = np.zeros(len(view))
        has_map = np.flatnonzero(self.offsets[view + 1] > self.offsets[view])
        if len(has_map):
            of = view[has_map]
            sizes, photographs = self.sizes_px[of], photograph_sizes_px[of]
            # the pixel of the map in which the centre of the photograph's pixel lies
            column = (2 * x[has_map] + 1) * sizes[:, 0] // (2 * photographs[:, 0])
            row = (2 * y[has_map] + 1) * sizes[:, 1] // (2 * photographs[:, 1])
            stored = self.values.values[self.offsets[of] + row * sizes[:, 0] + column]
            depth[has_map] = stored * self.unit_world[of]
        return depth


def find_depth_maps(
    names: Sequence[str], on_disk: Mapping[str, Path], named: Mapping[str, str]
) -> tuple[Path | None, ...]:
    """Return the depth map of each photograph, or None.

    Args:
        names: of the photographs.
        on_disk: files of a folder of depth maps, by their paths below it, in Unicode form NFC.
        named: paths that a transforms file gives, by the names of the photographs.
    """
    by_name = {name.casefold(): path for name, path in on_disk.items()} | dict(on_disk)
    found = []
    for name in names:
        photograph = PurePosixPath(normalize_name(name))
        stems = [photograph.with_suffix("").as_posix(), photograph.as_posix()]
        candidates = [f"{stem}{suffix}" for stem in stems for suffix in sorted(IMAGE_SUFFIXES)]
        if name in named:
            candidates = [*_paths_below_folder(named[name]), *candidates]
        paths = (by_name.get(each) or by_name.get(each.casefold()) for each in candidates)
        found.append(next((path for path in paths if path is not None), None))
    return tuple(found)


def _paths_below_folder(named: str) -> list[str]:
    """Return what a path in a transforms file may be called below the folder of the maps, longest first."""
    parts = PurePosixPath(normalize_name(named).replace("\\", "/")).parts
    folders = [place for place, part in enumerate(parts[:-1]) if part in DEPTH_FOLDERS]
    # below another folder, which may have been renamed, its name alone counts too
    count = folders[-1] + 2 if folders else len(parts)
    return ["/".join(parts[start:]) for start in range(count)]


def read_depth_map(path: Path) -> tuple[Float32[np.ndarray, "h w"], bool]:
    """Read the stored values of a depth map, 0 where nothing is known, and whether they are integers.

    Raises:
        DatasetError: the file is no whole image, or has 8 bits.
    """
    source, spec = open_image(path)
    kind = spec.format.basetype
    if kind in (oiio.UINT8, oiio.INT8):
        source.close()
        raise DatasetError(
            f"{path} has 8 bits a pixel, which are too few for depths; store depths as 16-bit PNG "
            "(millimetres) or EXR (metres)."
        )
    names = [name.rsplit(".", 1)[-1].upper() for name in spec.channelnames]
    channel = names.index("Z") if "Z" in names else 0
    # integers as they are stored, since a change of type stretches them over its range
    stored = _INTEGERS.get(kind)
    pixels = read_pixels(source, path, stored or "float")
    depth = np.ascontiguousarray(pixels[..., channel]).astype(np.float32)
    known = (depth > 0) & (depth < MAX_STORED)
    return np.where(known, depth, np.float32(0.0)), stored is not None


def depth_maps_digest(model: DatasetModel, geometry: KnownGeometry | None = None) -> str | None:
    """Return one digest of all depth maps of a scene, and of which photograph each belongs to; None without.

    Args:
        model: the scene.
        geometry: what is known beside the maps.

    Raises:
        DatasetError: a file cannot be read.
    """
    if geometry is None and all(view.depth_path is None for view in model.views):
        return None
    total = hashlib.sha256()
    if geometry is not None:
        total.update(f"geometry\0{geometry.sha256}\0".encode())
    for view in model.views:
        if view.depth_path is not None:
            total.update(f"{view.name}\0{file_sha256(view.depth_path)}\0".encode())
    return total.hexdigest()


def open_depth_maps(
    model: DatasetModel,
    folder: Path,
    digest: str,
    *,
    unit_world: float | None = None,
    threads: int = 1,
    geometry: KnownGeometry | None = None,
) -> DepthMaps:
    """Map the depth maps of a scene, decoding them into ``folder`` first unless they are there already.

    Args:
        model: the scene.
        folder: of the cache.
        digest: of the maps, see :func:`depth_maps_digest`.
        unit_world: world units for one unit of the stored values; None takes millimetres for integers and
            metres for others.
        threads: for decoding; 0 takes one per processor.
        geometry: gives maps to the photographs that have none.

    Raises:
        DatasetError: a map, or the geometry, cannot be used.
        SceneFileError: likewise.
        OutputError: the cache cannot be written.
    """
    have_maps = [geometry is not None or view.depth_path is not None for view in model.views]
    if geometry is not None:
        seeing = tuple(view for view in model.views if view.depth_path is None)
        digest = digest_with_cameras(digest, Viewpoints(seeing, model.cameras))
    index = _read_index(folder, digest, have_maps)
    if index is None:
        index = _decode(model, folder, digest, threads, geometry)
    sizes = np.array(index["sizes_px"], np.int64)
    units = np.where(index["are_integers"], INTEGER_UNIT, 1.0)
    if unit_world is not None:
        units = np.full(len(units), float(unit_world))
    of_geometry = np.array([geometry is not None and view.depth_path is None for view in model.views])
    return DepthMaps(
        MappedArray.open(folder / _VALUES, np.float32),
        np.concatenate([[0], np.cumsum(sizes.prod(axis=1))]).astype(np.int64),
        sizes,
        np.where(of_geometry, 1.0, units),
        of_geometry,
        np.array(index["have_depths"]),
    )


def fit_unit(maps: DepthMaps, model: DatasetModel, views: Int64[np.ndarray, " t"]) -> tuple[DepthMaps, str]:
    """Return the maps in the unit of the scene, found by its sparse points, and a sentence about it.

    Args:
        maps: of the scene.
        model: the scene.
        views: training views, whose observations count.

    Raises:
        DatasetError: no one scale makes the maps fit the points.
    """
    ratios = _depth_ratios(maps, model, views[~maps.are_of_geometry[views]])
    count = sum(view.depth_path is not None for view in model.views)
    if len(ratios) < MIN_POINTS:
        return maps, (
            f"The depth maps of {count} photographs are taken in metres (millimetres where they are "
            "integers), as too few sparse points show the unit of the scene; --depth-unit states another."
        )
    scale = float(np.median(ratios))
    spread = float(np.median(np.abs(ratios / scale - 1)))
    if spread > MAX_SPREAD:
        raise DatasetError(
            f"The depth maps of {model.root} do not fit its poses: at half of {len(ratios)} sparse points "
            f"they are more than {100 * spread:.0f} % off, whatever their unit. They must hold distances "
            "along the axis of view (z) of these photographs; mend them, take the folder away, or state "
            "their unit (--depth-unit)."
        )
    fitted = replace(maps, unit_world=np.where(maps.are_of_geometry, 1.0, maps.unit_world * scale))
    return fitted, (
        f"The depth maps of {count} photographs are used: one metre of theirs is {scale:.4g} units of the "
        f"scene, by {len(ratios)} sparse points, half of which agree within {100 * spread:.1f} %."
    )


def check_geometry(
    maps: DepthMaps, model: DatasetModel, views: Int64[np.ndarray, " t"], geometry: KnownGeometry
) -> str:
    """Check by the sparse points that the known geometry stands where the photographs show it.

    Args:
        maps: of the scene, those of the geometry among them.
        model: the scene.
        views: training views, whose observations count.
        geometry: of the scene.

    Returns:
        A sentence about it.

    Raises:
        DatasetError: no photograph shows it, or it stands elsewhere.
    """
    seeing = int((maps.are_of_geometry & maps.have_depths).sum())
    way_out = "it must be in the coordinates of the poses; move it there, or take the file away."
    if seeing == 0 and maps.are_of_geometry.any():
        raise DatasetError(f"{geometry.path} is seen by none of the photographs: {way_out}")
    ratios = _depth_ratios(maps, model, views[maps.are_of_geometry[views]])
    sentence = f"{geometry.path.name} is taken as known geometry; {seeing} photographs see it"
    if len(ratios) < MIN_POINTS:
        return f"{sentence}, and too few sparse points lie on it to show whether it stands right."
    share = float((np.abs(ratios - 1) < GEOMETRY_TOLERANCE).mean())
    if share < MIN_AGREEING:
        raise DatasetError(
            f"{geometry.path} does not stand where the photographs show it: of {len(ratios)} sparse points "
            f"{100 * share:.0f} % lie within {100 * GEOMETRY_TOLERANCE:.0f} % of its depth: {way_out}"
        )
    return (
        f"{sentence}, and {100 * share:.0f} % of {len(ratios)} sparse points lie within "
        f"{100 * GEOMETRY_TOLERANCE:.0f} % of its depth."
    )


def _depth_ratios(
    maps: DepthMaps, model: DatasetModel, views: Int64[np.ndarray, " t"]
) -> Float64[np.ndarray, " k"]:
    """Return depths of observed sparse points in the model over those in the maps."""
    points, seen = model.points, model.observations
    rows, is_there = points.rows_of(seen.point)
    sizes = np.array([[view.width_px, view.height_px] for view in model.views], np.int64)
    column, row = np.floor(seen.xy_px).astype(np.int64).T
    width, height = sizes[seen.view].T
    counted = is_there & np.isin(seen.view, views)
    counted &= (column >= 0) & (row >= 0) & (column < width) & (row < height)
    view, rows, column, row = seen.view[counted], rows[counted], column[counted], row[counted]
    axes = np.stack([each.rotation_cam_from_world[2] for each in model.views])
    shifts = np.array([each.translation_cam_from_world[2] for each in model.views])
    in_model = np.einsum("nk,nk->n", points.xyz_world[rows].astype(np.float64), axes[view]) + shifts[view]
    in_map = maps.z_world(view, row, column, sizes)
    known = (in_map > 0) & (in_model > 0)
    return in_model[known] / in_map[known]


def _read_if_there(path: Path | None) -> tuple[Float32[np.ndarray, "h w"], bool] | None:
    return None if path is None else read_depth_map(path)


class _Index(TypedDict):
    version: int
    digest: str
    sizes_px: list[list[int]]
    are_integers: list[bool]
    have_depths: list[bool]
    results: int


def _read_index(folder: Path, digest: str, have_maps: Sequence[bool]) -> _Index | None:
    """Return the index if it is of these maps and these views, of which some have none; else None."""
    try:
        index: _Index = json.loads((folder / _INDEX).read_text(encoding="utf-8"))
        count = sum(width * height for width, height in index["sizes_px"])
        is_whole = (folder / _VALUES).stat().st_size == 4 * count
    except (OSError, ValueError, KeyError, TypeError):
        return None
    is_same = index.get("version") == CACHE_VERSION and index.get("digest") == digest
    is_same = is_same and versions.has_same_results(index)
    # the digest does not know of views without a map
    is_same = is_same and [width > 0 for width, _ in index["sizes_px"]] == list(have_maps)
    return index if is_whole and is_same else None


def _decode(
    model: DatasetModel, folder: Path, digest: str, threads: int, geometry: KnownGeometry | None
) -> _Index:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / _INDEX).unlink(missing_ok=True)  # an index must never describe a file that is being written
    sizes_px: list[list[int]] = []
    are_integers: list[bool] = []
    have_depths: list[bool] = []
    workers = threads or os.cpu_count() or 1
    with (
        ThreadPoolExecutor(workers) as pool,
        atomic_replace(folder / _VALUES) as path,
        path.open("wb") as file,
    ):
        of_geometry = None
        if geometry is not None:
            mesh = geometry.read().about(model.origin_world, has_same_axes=True)
            of_geometry = GeometryDepths(mesh, threads)
        paths = (view.depth_path for view in model.views)
        decoded = read_ahead(_read_if_there, paths, pool, 2 * workers)
        for view, found in zip(model.views, decoded, strict=True):
            depth, is_integer = (np.zeros((0, 0), np.float32), False) if found is None else found
            if found is not None:
                _check_sides(view.depth_path, depth.shape, (view.width_px, view.height_px))
            elif of_geometry is not None:
                depth = of_geometry.view(view, model.cameras[view.camera_index])
            sizes_px.append([depth.shape[1], depth.shape[0]])
            are_integers.append(is_integer)
            have_depths.append(bool(depth.any()))
            file.write(depth.tobytes())
    index: _Index = {
        "version": CACHE_VERSION, "digest": digest, "sizes_px": sizes_px, "are_integers": are_integers,
        "have_depths": have_depths, "results": versions.RESULTS_VERSION,
    }  # fmt: skip
    write_json(folder / _INDEX, index)
    return index


def _check_sides(path: Path | None, shape: tuple[int, ...], photograph_px: tuple[int, int]) -> None:
    """Refuse a map whose ratio of sides is not that of its photograph, but for the rounding of a side."""
    height, width = shape
    of_width, of_height = photograph_px
    step = max(width / of_width, height / of_height, 1.0)
    if abs(width * of_height - height * of_width) > step * max(of_width, of_height):
        raise DatasetError(
            f"{path} is {width}x{height} but its photograph is {of_width}x{of_height}; a depth map shows "
            "what its photograph shows, with the same ratio of sides."
        )
