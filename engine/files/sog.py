"""SOG of PlayCanvas: lossless images of quantised parameters with a ``meta.json``, zipped or in a folder.

Version 2 looks scales and colors up in code books; the older layout without a version spreads them between
bounds. Positions have 16 bits in sign(x) ln(1 + |x|); higher harmonics are entries of a palette. Written by
the program splat-transform, where that is.
"""

import json
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.image_messages import image_message
from octasplat.engine.core.partial_folders import partial_folder
from octasplat.engine.core.writing import atomic_replace
from octasplat.engine.files.channel_columns import ChannelChoice
from octasplat.engine.files.encodings import SQRT_HALF, from_smallest_three, logits_from_bytes
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.files.range_losses import find_position_losses, find_thickness_losses
from octasplat.engine.files.registry import Exporter, Importer, register
from octasplat.engine.files.splat_rows import select_for_export
from octasplat.engine.files.splat_transform import convert, missing_converter
from octasplat.engine.gaussians.flattening import CloudBlocks, GaussianCloud, join_blocks, row_slices
from octasplat.engine.gaussians.model import FlatGaussians

META_FILE = "meta.json"
PALETTE_COLUMNS = 64
FIRST_QUAT_TAG = 252
"""Alpha 252 to 255 says which of w, x, y, z is left out."""
MAX_FILE_BYTES = 1 << 31
_REST_COUNTS = {0: 0, 1: 3, 2: 8, 3: 15}


class _ParameterMeta(BaseModel):
    """Entry of ``meta.json`` for one parameter, in either version."""

    model_config = ConfigDict(extra="ignore")

    files: list[str]
    shape: list[int] = Field(default_factory=list)
    mins: list[float] | float = Field(default_factory=list)
    maxs: list[float] | float = Field(default_factory=list)
    codebook: list[float] | None = None
    bands: int | None = Field(default=None, ge=0, le=3)


class _Meta(BaseModel):
    model_config = ConfigDict(extra="ignore")

    version: int = 1
    count: int | None = Field(default=None, ge=0)
    means: _ParameterMeta
    scales: _ParameterMeta
    quats: _ParameterMeta
    sh0: _ParameterMeta
    shN: _ParameterMeta | None = None
    antialias: bool = False


Images = Callable[[str], UInt8[np.ndarray, "h w 4"]]


def read(path: Path) -> GaussianCloud:
    """Read a ``.sog`` bundle, or the ``meta.json`` beside its images.

    Raises:
        SceneFileError: the file is no SOG, an image is missing or too small, or a number is out of range.
    """
    return join_blocks(_read_blocks(path), path)


def _read_blocks(path: Path, _channels: ChannelChoice = "own") -> CloudBlocks:
    """Return the Gaussians some thousands at a time; the images are in memory, in bytes."""
    try:
        if path.stat().st_size == 0:
            raise SceneFileError(f"{path}: is empty.")
        if path.name != META_FILE and not zipfile.is_zipfile(path):
            raise SceneFileError(f"{path}: is no SOG bundle, which is a ZIP archive, or it is damaged.")
        if path.name == META_FILE:
            return _decode(path, path.read_bytes(), _folder_images(path))
        with zipfile.ZipFile(path) as bundle, tempfile.TemporaryDirectory(prefix="octasplat-") as folder:
            return _decode(
                path, _bundle_member(path, bundle, META_FILE), _bundle_images(path, bundle, Path(folder))
            )
    # RuntimeError: a member is encrypted; NotImplementedError: a compression that zipfile lacks
    except (OSError, zipfile.BadZipFile, RuntimeError, NotImplementedError) as error:
        raise SceneFileError(f"{path}: is damaged or cannot be read ({error}).") from error


def _folder_images(path: Path) -> Images:
    def load(name: str) -> UInt8[np.ndarray, "h w 4"]:
        # The name alone, so that nothing outside the folder is read
        return _rgba_pixels(path, name, path.parent / Path(name).name)

    return load


def _bundle_images(path: Path, bundle: zipfile.ZipFile, folder: Path) -> Images:
    def load(name: str) -> UInt8[np.ndarray, "h w 4"]:
        image = folder / Path(name).name
        image.write_bytes(_bundle_member(path, bundle, name))
        return _rgba_pixels(path, name, image)

    return load


def _bundle_member(path: Path, bundle: zipfile.ZipFile, name: str) -> bytes:
    """Return a file of the bundle, at its root or in its only folder."""
    names = [info for info in bundle.infolist() if info.filename.rpartition("/")[2] == Path(name).name]
    if not names:
        raise SceneFileError(f"{path}: is no SOG bundle; it lacks {name}.")
    if names[0].file_size > MAX_FILE_BYTES:
        raise SceneFileError(f"{path}: its {name} would unpack to {names[0].file_size} bytes.")
    return bundle.read(names[0])


def _rgba_pixels(path: Path, name: str, image: Path) -> UInt8[np.ndarray, "h w 4"]:
    """Return the bytes of an image as they are stored, as RGBA."""
    import OpenImageIO as oiio  # which the front end has not

    if not image.exists():
        raise SceneFileError(f"{path}: its image {name} is missing.")
    # Alpha holds data, which must not be multiplied into the colors.
    as_stored = oiio.ImageSpec()
    as_stored["oiio:UnassociatedAlpha"] = 1
    source = oiio.ImageInput.open(str(image), as_stored)
    if source is None:
        raise SceneFileError(f"{path}: its image {name} cannot be read ({image_message(oiio)}).")
    try:
        pixels = source.read_image(format=oiio.UINT8)
        if pixels is None:
            raise SceneFileError(f"{path}: its image {name} is damaged ({image_message(source)}).")
    finally:
        source.close()
    if pixels.shape[2] < 3:
        raise SceneFileError(f"{path}: its image {name} should be RGB or RGBA.")
    if pixels.shape[2] == 3:
        return np.concatenate([pixels, np.full_like(pixels[:, :, :1], 255)], axis=2)
    return np.ascontiguousarray(pixels[:, :, :4])


def _decode(path: Path, text: bytes, images: Images) -> CloudBlocks:
    try:
        meta = _Meta.model_validate(json.loads(text))
    except (ValidationError, ValueError, RecursionError) as error:
        words = " ".join(str(error).split())[:200]
        raise SceneFileError(f"{path}: its {META_FILE} does not describe a SOG ({words}).") from error
    if meta.version not in (1, 2):
        raise SceneFileError(f"{path}: is SOG version {meta.version}; versions 1 and 2 are read.")
    count = meta.count if meta.count is not None else (meta.means.shape or [0])[0]
    if count <= 0:
        raise SceneFileError(f"{path}: holds no Gaussians.")

    def rgba(part: _ParameterMeta, number: int = 0) -> UInt8[np.ndarray, "n 4"]:
        if len(part.files) <= number:
            raise SceneFileError(f"{path}: its {META_FILE} names too few images.")
        pixels = images(part.files[number]).reshape(-1, 4)
        if len(pixels) < count:
            raise SceneFileError(
                f"{path}: its image {part.files[number]} holds {len(pixels)} of {count} Gaussians."
            )
        return pixels[:count]

    pixels = {
        "low": rgba(meta.means),
        "high": rgba(meta.means, 1),
        "scales": rgba(meta.scales),
        "color": rgba(meta.sh0),
        "quats": rgba(meta.quats),
    }
    palette = None
    if meta.shN is not None:
        palette = _palette(path, meta.shN, images)
        pixels["labels"] = rgba(meta.shN, 1)

    def block(rows: slice) -> GaussianCloud:
        return _decode_rows(path, meta, {name: image[rows] for name, image in pixels.items()}, palette)

    return CloudBlocks(count, ((rows, block(rows)) for rows in row_slices(count)))


def _decode_rows(
    path: Path,
    meta: _Meta,
    pixels: Mapping[str, UInt8[np.ndarray, "n 4"]],
    palette: Float32[np.ndarray, "p k 3"] | None,
) -> GaussianCloud:
    """Return the Gaussians of some pixels of each image."""
    low, high = pixels["low"][:, :3], pixels["high"][:, :3]
    # One image has the low bytes, the other the high ones.
    curved = _dequantise(path, meta.means, (low.astype(np.float64) + 256.0 * high) / 65535.0)
    color = pixels["color"]
    if meta.version == 2:
        scales = _codebook_values(path, meta.scales, pixels["scales"][:, :3])
        constant = _codebook_values(path, meta.sh0, color[:, :3])
        logits = logits_from_bytes(color[:, 3])
    else:
        scales = _dequantise(path, meta.scales, pixels["scales"][:, :3] / 255.0).astype(np.float32)
        both = _dequantise(path, meta.sh0, color / 255.0).astype(np.float32)
        constant, logits = both[:, :3], both[:, 3]
    sh = constant[:, None, :]
    if palette is not None:
        sh = np.concatenate([sh, _sh_rest(path, palette, pixels["labels"])], axis=1)
    return GaussianCloud(
        # inverse of sign(x) ln(1 + |x|)
        means_world=(np.sign(curved) * np.expm1(np.abs(curved))).astype(np.float32),
        quats_wxyz=_decode_rotations(pixels["quats"]),
        log_scales=scales,
        opacity_logits=np.ascontiguousarray(logits),
        sh=np.ascontiguousarray(sh),
        notes=("The scene was trained with antialiasing, which is not modelled here.",) * meta.antialias,
    )


def _dequantise(path: Path, part: _ParameterMeta, share: np.ndarray) -> np.ndarray:
    """Scale numbers in [0, 1] to the bounds of their channel."""
    low, high = _as_float_array(path, part.mins), _as_float_array(path, part.maxs)
    if not len(low) == len(high) == share.shape[1]:
        raise SceneFileError(
            f"{path}: its {META_FILE} should give {share.shape[1]} bounds for {part.files[0]}."
        )
    spread: np.ndarray = low + (high - low) * share
    return spread


def _codebook_values(path: Path, part: _ParameterMeta, codes: np.ndarray) -> Float32[np.ndarray, "*shape"]:
    book = _as_float_array(path, part.codebook or [])
    if len(book) != 256:
        raise SceneFileError(f"{path}: the code book for {part.files[0]} should have 256 entries.")
    return book.astype(np.float32)[codes]


def _as_float_array(path: Path, values: Sequence[float] | float) -> np.ndarray:
    numbers: np.ndarray = np.asarray(values, dtype=np.float64).reshape(-1)
    if not np.isfinite(numbers).all():
        raise SceneFileError(f"{path}: its {META_FILE} holds numbers that are not finite.")
    return numbers


def _decode_rotations(rgba: UInt8[np.ndarray, "n 4"]) -> Float32[np.ndarray, "n 4"]:
    """Decode quaternions of three byte components and the tag of the fourth; other tags mean no rotation."""
    small = (rgba[:, :3] / 255.0 * 2.0 - 1.0) * SQRT_HALF
    quats = from_smallest_three(small, np.maximum(rgba[:, 3].astype(np.int64) - FIRST_QUAT_TAG, 0))
    quats[rgba[:, 3] < FIRST_QUAT_TAG] = (1.0, 0.0, 0.0, 0.0)
    return quats


def _palette(path: Path, part: _ParameterMeta, images: Images) -> Float32[np.ndarray, "p k 3"]:
    """Decode the palette of higher harmonics, 64 entries a row."""
    pixels = images(part.files[0])
    rows, width = pixels.shape[:2]
    k = width // PALETTE_COLUMNS
    if k not in _REST_COUNTS.values() or k == 0 or width % PALETTE_COLUMNS:
        raise SceneFileError(
            f"{path}: its image {part.files[0]} is {width} pixels wide, not 192, 512 or 960."
        )
    if part.bands is not None and _REST_COUNTS[part.bands] != k:
        raise SceneFileError(f"{path}: its image {part.files[0]} does not fit {part.bands} bands.")
    if part.codebook is not None:
        palette = _codebook_values(path, part, pixels[:, :, :3])
    else:
        low, high = _as_float_array(path, part.mins), _as_float_array(path, part.maxs)
        if len(low) != 1 or len(high) != 1:
            raise SceneFileError(f"{path}: its {META_FILE} should give one bound for {part.files[0]}.")
        palette = (low + (high - low) * (pixels[:, :, :3] / 255.0)).astype(np.float32)
    return palette.reshape(rows * PALETTE_COLUMNS, k, 3)


def _sh_rest(
    path: Path, palette: Float32[np.ndarray, "p k 3"], labels: UInt8[np.ndarray, "n 4"]
) -> Float32[np.ndarray, "n k 3"]:
    """Decode higher harmonics: each Gaussian indexes the palette."""
    # low byte in red, high byte in green
    entry = labels[:, 0].astype(np.int64) + 256 * labels[:, 1].astype(np.int64)
    if len(entry) and int(entry.max()) >= len(palette):
        raise SceneFileError(
            f"{path}: some Gaussians name harmonics beyond the {len(palette)} of its palette."
        )
    return palette[entry]


def write(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write a bundled SOG; the program puts the Gaussians into an order of its own.

    Raises:
        SceneFileError: nothing to write, values that are not finite, or the program is missing or fails.
        OSError: the file cannot be written.
    """
    scene = select_for_export(gaussians, path, options)
    # beside the file, as the folder of the system may be in memory
    with partial_folder(path) as folder, atomic_replace(path) as temporary:
        source, target = folder / "scene.ply", folder / "scene.sog"
        write_gaussian_ply(scene, source)
        try:
            convert(source, target)
        except SceneFileError as error:
            raise SceneFileError(str(error).replace(str(target), str(path), 1)) from error
        shutil.copyfile(target, temporary)
    return (path,)


def find_sog_losses(scene: FlatGaussians) -> tuple[str, ...]:
    """Return what positions of 16 bits, and the thickness, lose of a scene, in sentences."""
    if len(scene) == 0 or not scene.is_finite():
        return ()  # which is refused
    ends = np.stack([scene.means_world.min(axis=0), scene.means_world.max(axis=0)]).astype(np.float64)
    step = np.ptp(np.sign(ends) * np.log1p(np.abs(ends)), axis=0) / 65535.0

    def steps_world(rows: slice) -> Float64[np.ndarray, " n"]:
        # dx = (1 + |x|) d(ln(1 + |x|))
        steps = (1.0 + np.abs(scene.means_world[rows].astype(np.float64))) * step
        return np.asarray(steps.max(axis=1))

    return (*find_thickness_losses("sog", scene), *find_position_losses("sog", scene, steps_world))


def _recognises(head: bytes) -> bool:
    return head.startswith(b"PK\x03\x04")


register(
    Importer(
        "sog",
        ("*.sog", META_FILE),
        "SOG of PlayCanvas, bundled or as a folder's meta.json",
        read,
        _recognises,
        read_blocks=_read_blocks,
    )
)
register(
    Exporter(
        "sog",
        ("*.sog",),
        "SOG of PlayCanvas, the smallest; needs splat-transform",
        write,
        missing_converter,
        holds_harmonics=True,
        find_losses=find_sog_losses,
    )
)
