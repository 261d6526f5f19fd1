"""The pixel cache: all photographs of a scene, decoded and reduced, as flat files to be mapped.

``rgb.bin`` holds the colors of all views one after the other, row by row, as uint8 or, if any photograph
is deeper, uint16; ``alpha.bin`` and ``mask.bin`` hold one byte per pixel and exist only where
needed.
``pixels.json`` says from which files they were made: by digests of their contents, and by a stamp of their
folder, sizes and times, which spares reading them again. What a version with other results has decoded is
decoded again.
"""

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict

import numpy as np
from jaxtyping import Int64

from octasplat.engine.core import versions
from octasplat.engine.core.errors import DamagedImageError, DatasetError, DiskFullError, OutputError
from octasplat.engine.core.writing import atomic_replace, write_json
from octasplat.engine.dataset.damaged_images import (
    collect_results,
    decoding_workers,
    find_damaged,
    refuse_damaged,
)
from octasplat.engine.dataset.image_info import ImageInfo, Storage
from octasplat.engine.dataset.images import ValueScale, read_photo
from octasplat.engine.dataset.mapped_array import MappedArray
from octasplat.engine.dataset.masks import MaskSummary, check_masks, read_mask
from octasplat.engine.dataset.model import DatasetModel, DatasetView
from octasplat.engine.dataset.value_scale import find_value_scales
from octasplat.engine.dataset.views_file import FileDigests

CACHE_VERSION = 4
"""Raised whenever the contents of the cache files change for the same photographs."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class PixelCache:
    """Mapped planes of all views; ``alpha`` and ``mask`` are empty where no view has them.

    Attributes:
        rgb: straight display colors, 3 values per pixel.
        alpha: 255 where opaque, one value per pixel.
        mask: 255 where valid, one value per pixel.
        offsets: first pixel of every view, and the count of all pixels at the end.
        digests: of the files of every view.
        warnings: one sentence each on what is odd but usable.
        scales: of the values of storages that are not as their formats say.
        is_partial: whether some views have no pixels here.
    """

    rgb: MappedArray
    alpha: MappedArray
    mask: MappedArray
    offsets: Int64[np.ndarray, " views_and_end"]
    digests: tuple[FileDigests, ...]
    warnings: tuple[str, ...]
    scales: Mapping[Storage, ValueScale]
    is_partial: bool = False

    def require(self, view: Int64[np.ndarray, " n"]) -> None:
        """Refuse pixels of views that a partial cache does not hold.

        Raises:
            IndexError: there is one.
        """
        if self.is_partial:
            inside = view[(view >= 0) & (view < len(self.digests))]
            lacking = inside[np.diff(self.offsets)[inside] == 0]
            if len(lacking):
                raise IndexError(f"the photograph of view {lacking[0]} is not among those that were opened")


@dataclass(frozen=True)
class CacheForm:
    """What all photographs of a scene decide together, where only some of them are decoded.

    Attributes:
        bits: 8 or 16, of the deepest of them.
        has_alpha: whether any of them is transparent anywhere.
        has_masks: whether any of them has a mask.
        scales: of the values of storages that are not as their formats say.
    """

    bits: int
    has_alpha: bool
    has_masks: bool
    scales: Mapping[Storage, ValueScale]


def file_digests(model: DatasetModel, folder: Path, *, threads: int = 0) -> tuple[FileDigests, ...]:
    """Return digests of the files of every view, from the cache in ``folder`` if it is of these files.

    Raises:
        DatasetError: a file cannot be read.
    """
    index = _read_index(folder, sum(view.width_px * view.height_px for view in model.views))
    if index is not None and index["stamp"] == _cache_key(model):
        return tuple(FileDigests(*pair) for pair in index["digests"])
    with ThreadPoolExecutor(threads if threads > 0 else os.cpu_count() or 1) as pool:
        return tuple(pool.map(_file_digests, model.views))


def open_pixel_cache(
    model: DatasetModel,
    folder: Path,
    digests: Sequence[FileDigests] | None = None,
    *,
    threads: int = 0,
    progress: Progress | None = None,
    form: CacheForm | None = None,
) -> PixelCache:
    """Map the pixels of ``model``, decoding them into ``folder`` first unless they are there already.

    Args:
        model: the scene.
        folder: folder of the cache files.
        digests: of the files of every view, if they are known; files that only moved, or were copied, are
            then not decoded again.
        threads: decoding threads; 0 takes one per processor. Fewer run where photographs are huge.
        progress: called with (photographs done, total) while decoding.
        form: of the cache of all photographs, where ``model`` has only some of their views.

    Raises:
        DatasetError: a photograph or a mask cannot be read.
        OutputError: the cache cannot be written.
    """
    sizes = [view.width_px * view.height_px for view in model.views]
    offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    stamp, sizes_px = _cache_key(model), [[view.width_px, view.height_px] for view in model.views]
    known = None if digests is None else [(each.photograph, each.mask) for each in digests]
    index = _read_index(folder, int(offsets[-1]))
    if index is not None and index["stamp"] != stamp:
        # JSON has lists where digests are pairs
        if [(*pair,) for pair in index["digests"]] == known and index["sizes_px"] == sizes_px:
            index["stamp"] = stamp
            write_json(folder / "pixels.json", index)
        else:
            index = None
    if index is None:
        _build_cache(model, folder, offsets, stamp, threads=threads, progress=progress, form=form)
        index = _read_index(folder, int(offsets[-1]))
        if index is None or index["stamp"] != stamp:
            raise OutputError(
                f"The pixel cache in {folder} changed while it was written; use another folder."
            )
    rgb_type = np.uint8 if index["bits"] == 8 else np.uint16
    return PixelCache(
        rgb=MappedArray.open(folder / "rgb.bin", rgb_type),
        alpha=_open_plane(folder / "alpha.bin", index["alpha"]),
        mask=_open_plane(folder / "mask.bin", index["mask"]),
        offsets=offsets,
        digests=tuple(FileDigests(*pair) for pair in index["digests"]),
        warnings=tuple(index["warnings"]),
        scales={name: ValueScale(*scale) for name, scale in index["scales"].items()},
    )


def has_former_cache(folder: Path) -> bool:
    """Return whether the pixels in a folder are of a version with other results, and so decoded again."""
    try:
        index = json.loads((folder / "pixels.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(index, dict) and not versions.has_same_results(index)


class _Index(TypedDict):
    version: int
    results: int
    stamp: str
    digests: list[tuple[str, str | None]]
    sizes_px: list[list[int]]
    bits: int
    alpha: bool
    mask: bool
    warnings: list[str]
    scales: dict[Storage, tuple[float, bool]]


def _open_plane(path: Path, exists: bool) -> MappedArray:
    return MappedArray.open(path, np.uint8) if exists else MappedArray.empty(np.uint8)


def _cache_key(model: DatasetModel) -> str:
    """Return a key of the files by their paths, sizes and times, and of the size of the views."""
    sources: list[object] = [str(model.root.resolve())]
    for view in model.views:
        for path in (view.image_path, view.mask_path):
            if path is None:
                sources.append(None)
                continue
            stat = path.stat()
            sources.append([str(path.relative_to(model.root)), stat.st_size, stat.st_mtime_ns])
        sources.append([view.width_px, view.height_px])
    return hashlib.sha256(json.dumps(sources).encode()).hexdigest()


def _file_digests(view: DatasetView) -> FileDigests:
    photograph = file_sha256(view.image_path)
    return FileDigests(photograph, None if view.mask_path is None else file_sha256(view.mask_path))


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file of the scene, hexadecimal.

    Raises:
        DatasetError: it cannot be read.
    """
    try:
        with path.open("rb") as handle:
            return hashlib.file_digest(handle, "sha256").hexdigest()
    except OSError as error:
        raise DatasetError(f"{path} cannot be read ({error.strerror}); replace the file.") from error


def _read_index(folder: Path, pixels: int) -> _Index | None:
    """Return the index if its versions and the sizes of its files are as expected; else None."""
    try:
        index: _Index = json.loads((folder / "pixels.json").read_text(encoding="utf-8"))
        expected = {"rgb.bin": 3 * pixels * index["bits"] // 8}
        expected |= {f"{name}.bin": pixels for name in ("alpha", "mask") if index[name]}
        is_complete = all((folder / name).stat().st_size == size for name, size in expected.items())
        is_current = index["version"] == CACHE_VERSION and versions.has_same_results(index)
        return index if is_complete and is_current else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _build_cache(
    model: DatasetModel,
    folder: Path,
    offsets: Int64[np.ndarray, " views_and_end"],
    stamp: str,
    threads: int,
    progress: Progress | None,
    form: CacheForm | None,
) -> None:
    infos, pixels = model.image_infos, int(offsets[-1])
    bits = max(info.bits for info in infos) if form is None else form.bits
    planes = {"rgb": 3 * pixels * bits // 8}
    if any(info.has_alpha for info in infos) if form is None else form.has_alpha:
        planes["alpha"] = pixels
    if any(view.mask_path is not None for view in model.views) if form is None else form.has_masks:
        planes["mask"] = pixels
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # First of all: an index must never describe files that are being written.
        (folder / "pixels.json").unlink(missing_ok=True)
        with ExitStack() as stack:
            files: dict[str, int] = {}
            for name, size in planes.items():
                temporary = stack.enter_context(atomic_replace(folder / f"{name}.bin"))
                # Plain descriptors, as threads write with pwrite(), which needs no shared position
                files[name] = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
                stack.callback(os.close, files[name])
                os.posix_fallocate(files[name], 0, size)  # a full disk shows now, not after an hour
            summaries, scales, warnings = _decode_all(
                model=model, offsets=offsets, bits=bits, files=files, threads=threads, progress=progress,
                scales=None if form is None else form.scales,
            )  # fmt: skip
        # Many RGBA files are opaque throughout; their plane would only cost memory traffic.
        transparent = any(each.is_transparent for each in summaries) if form is None else form.has_alpha
        for name in ("alpha", "mask"):
            if name not in planes or (name == "alpha" and not transparent):
                (folder / f"{name}.bin").unlink(missing_ok=True)
    except DiskFullError as error:
        raise DiskFullError(f"{error} The pixel cache takes {sum(planes.values()) / 1e6:,.1f} MB.") from error
    except OSError as error:
        raise OutputError(
            f"The pixel cache cannot be written to {folder} ({error.strerror}); name another folder."
        ) from error
    if form is None:  # else all of them were judged together
        masks = [summary.mask for summary in summaries if summary.mask is not None]
        warnings += check_masks(masks, len(model.views))
    index: _Index = {
        "version": CACHE_VERSION,
        "results": versions.RESULTS_VERSION,
        "stamp": stamp,
        "digests": [(each.digests.photograph, each.digests.mask) for each in summaries],
        "sizes_px": [[view.width_px, view.height_px] for view in model.views],
        "bits": bits,
        "alpha": "alpha" in planes and transparent,
        "mask": "mask" in planes,
        "warnings": warnings,
        "scales": {name: (scale.full, scale.is_display) for name, scale in scales.items()},
    }
    # Last of all, as only the index makes the files valid
    write_json(folder / "pixels.json", index)


@dataclass(frozen=True)
class _ViewSummary:
    digests: FileDigests
    is_transparent: bool
    mask: MaskSummary | None


def _decode_all(
    model: DatasetModel,
    offsets: Int64[np.ndarray, " views_and_end"],
    bits: int,
    files: dict[str, int],
    threads: int,
    progress: Progress | None,
    scales: Mapping[Storage, ValueScale] | None,
) -> tuple[list[_ViewSummary], Mapping[Storage, ValueScale], list[str]]:
    """Decode all views into ``files``; return what was found, the scales of values, and warnings."""
    # Found below where they are not given, before any call of decode()
    known: Mapping[Storage, ValueScale] = scales or {}
    warnings: tuple[str, ...] = ()

    def decode(index: int) -> _ViewSummary:
        view, info = model.views[index], model.image_infos[index]
        return _decode_view(
            view=view,
            info=info,
            offset=int(offsets[index]),
            bits=bits,
            files=files,
            scale=known.get(info.storage),
        )

    count = len(model.views)
    photographs = [(view.image_path, info) for view, info in zip(model.views, model.image_infos, strict=True)]
    with ThreadPoolExecutor(decoding_workers(threads, model.image_infos)) as pool:
        if scales is None:
            try:
                known, warnings = find_value_scales(photographs, pool.map)
            except DamagedImageError:
                refuse_damaged(find_damaged(photographs, threads=threads), model.root)
                raise
        futures = [pool.submit(decode, index) for index in range(count)]
        try:
            summaries, faults = collect_results(
                futures, lambda done: None if progress is None else progress(done, count)
            )
        finally:
            # After an error the other photographs need not be decoded.
            pool.shutdown(cancel_futures=True)
    refuse_damaged(faults, model.root)
    return summaries, known, list(warnings)


def _decode_view(
    view: DatasetView,
    info: ImageInfo,
    offset: int,
    bits: int,
    files: dict[str, int],
    scale: ValueScale | None,
) -> _ViewSummary:
    width, height = view.width_px, view.height_px
    digests = _file_digests(view)  # the file is then at hand for the decoder
    rgb, alpha = read_photo(view.image_path, width, height, bits, scale)
    if rgb.shape != (height, width, 3):
        raise DatasetError(
            f"{view.image_path} changed while it was read; leave the scene alone until it is read."
        )
    _write_at_offset(files["rgb"], rgb, offset * 3 * bits // 8)
    if "alpha" in files:
        opaque = np.full((height, width), 255, dtype=np.uint8)
        _write_at_offset(files["alpha"], opaque if alpha is None else alpha, offset)
    summary = None
    if "mask" in files:
        mask = np.full((height, width), 255, dtype=np.uint8)
        if view.mask_path is not None:
            mask, summary = read_mask(view.mask_path, (info.width_px, info.height_px), width, height)
        _write_at_offset(files["mask"], mask, offset)
    return _ViewSummary(
        digests=digests,
        is_transparent=alpha is not None and int(alpha.min()) < 255,
        mask=summary,
    )


def _write_at_offset(file: int, values: np.ndarray, position: int) -> None:
    data = np.ascontiguousarray(values).data.cast("B")
    # A write may take less than it was given.
    while data:
        written = os.pwrite(file, data, position)
        data, position = data[written:], position + written
