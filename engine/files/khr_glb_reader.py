"""The splats of a binary glTF with ``KHR_gaussian_splatting``, or else its octagons, read as Gaussians."""

import contextlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.core.errors import ConfigError, SceneFileError
from octasplat.engine.files import glb_container, glb_parts
from octasplat.engine.files.channel_columns import ChannelChoice, select_channel_columns
from octasplat.engine.files.encodings import (
    MAX_SH_DEGREE,
    dropped_sh_message,
    half_turn_gaussians,
    sh0_from_rgb,
    turn_cloud,
)
from octasplat.engine.files.glb_container import GlbFile
from octasplat.engine.files.khr_glb import COLOR_SPACE, COMPRESSION, EXTENSION
from octasplat.engine.files.octagon_glb_reader import octagon_q, read_octagons
from octasplat.engine.files.registry import Importer, register
from octasplat.engine.files.spz import decode
from octasplat.engine.files.spz_container import SpzSource, parse_spz
from octasplat.engine.gaussians.channels import Channels, merge_widths
from octasplat.engine.gaussians.flattening import CloudBlocks, GaussianCloud, join_blocks, row_slices
from octasplat.engine.gaussians.model import SH_C0
from octasplat.engine.gaussians.rows import RowIndex

KERNEL, LINEAR_COLOR_SPACE = "ellipse", "lin_rec709_display"
SIMILARITY_TOLERANCE = 1e-4
"""Relative error up to which a node may fail to be a rotation with one scale."""


def read(path: Path, channels: ChannelChoice = "own") -> GaussianCloud:
    """Read all splats of the default scene, node transforms applied, or else its octagons.

    Args:
        path: the file.
        channels: which of the attributes that begin with _ become channels, by their names in lower case.

    Raises:
        SceneFileError: the file is no GLB, is damaged, holds neither splats nor octagons of ours, compressed
            splats or edited octagons, scales them unevenly, or has no such channel.
    """
    return join_blocks(_read_blocks(path, channels), path)


def _read_blocks(path: Path, channels: ChannelChoice = "own") -> CloudBlocks:
    """Return what :func:`read` does, some thousands of Gaussians at a time."""
    file = GlbFile(path)
    parts: list[_Splats] = []
    with _name_errors(path):
        for matrix, primitive in file.primitives():
            splats = primitive.get("extensions", {}).get(EXTENSION)
            if splats is None:
                continue
            attributes = primitive["attributes"]
            columns = {name[1:].lower(): number for name, number in attributes.items() if name[0] == "_"}
            declared = glb_container.declared_channel_attributes(file.document, columns)
            requested = select_channel_columns(path, declared, columns, channels)
            named = {name: tuple(columns[column] for column in own) for name, own in requested.items()}
            parts.append(_Splats(path, file, attributes, splats, file.about_origin(matrix), named))
        if not parts:
            q = octagon_q(file)
            if q is not None:
                found = read_octagons(file, path, q, channels)
                return CloudBlocks(found.count, _name_errors_of(path, found.blocks))
            raise SceneFileError(
                f"{path}: holds no splats ({EXTENSION}); if it is an edited octagon mesh, use octasplat edit."
            )
        return CloudBlocks(sum(part.count for part in parts), _name_errors_of(path, _blocks_of(parts)))


def _name_errors_of(
    path: Path, blocks: Iterable[tuple[RowIndex, GaussianCloud]]
) -> Iterator[tuple[RowIndex, GaussianCloud]]:
    with _name_errors(path):
        yield from blocks


def _blocks_of(parts: Sequence["_Splats"]) -> Iterator[tuple[slice, GaussianCloud]]:
    """Yield the Gaussians of all primitives, with the harmonics and channels of whichever has the most."""
    most = max(part.coefficients for part in parts)
    widths = merge_widths(part.no_channels for part in parts)
    start = 0
    for part in parts:
        for rows, cloud in part.blocks():
            padded = np.pad(cloud.sh, ((0, 0), (0, most - cloud.sh.shape[1]), (0, 0)))
            filled = cloud.channels.with_filled(widths, len(cloud.sh))
            yield slice(start + rows.start, start + rows.stop), replace(cloud, sh=padded, channels=filled)
        start += part.count


@contextlib.contextmanager
def _name_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except ConfigError as error:
        raise SceneFileError(f"{path}: {error}") from error
    except glb_container.GLB_READ_ERRORS as error:
        raise SceneFileError(f"{path}: its glTF is damaged or not understood ({error}).") from error


class _Splats:
    """The splats of a primitive.

    Attributes:
        count: number of Gaussians.
        coefficients: of the harmonics of each.
        no_channels: the channels that are wanted, without rows.
    """

    def __init__(
        self,
        path: Path,
        file: GlbFile,
        attributes: dict[str, int],
        splats: dict[str, Any],
        matrix: Float64[np.ndarray, "4 4"],
        channels: Mapping[str, tuple[int, ...]],
    ) -> None:
        """Look at what there is.

        Args:
            path: named in errors.
            file: it is from.
            attributes: accessors by their semantics.
            splats: what the extension says of them.
            matrix: of the node.
            channels: accessors of each channel that is wanted.

        Raises:
            SceneFileError: an extension or a kernel is needed that is not read.
        """
        self._path, self._file, self._attributes, self._matrix = path, file, attributes, matrix
        self._channels = channels
        self.no_channels = Channels(
            {
                name: np.concatenate([file.array(number, np.float32, slice(0)) for number in own], axis=1)
                for name, own in channels.items()
            }
        )
        further = splats.get("extensions", {})
        if unknown := ", ".join(name for name in further if name != COMPRESSION):
            raise SceneFileError(f"{path}: its splats need {unknown}, which is not read.")
        if (kernel := splats.get("kernel", KERNEL)) != KERNEL:  # drafts of the extension had none
            raise SceneFileError(f"{path}: its splats have the kernel {kernel}, which is not read.")
        self._packed: SpzSource | None = None
        color_space = splats.get("colorSpace", COLOR_SPACE)
        self._is_linear = color_space == LINEAR_COLOR_SPACE
        self._color_notes = _color_notes(color_space)
        self._notes = (
            *glb_parts.part_note(file.document),
            *dropped_sh_message(_sh_degree_of(attributes)),
        )
        if further:
            self._packed = parse_spz(path, file.view_bytes(further[COMPRESSION]["bufferView"]))
            self.count = self._packed.count
            coefficients = (min(self._packed.header.sh_degree, MAX_SH_DEGREE) + 1) ** 2
        else:
            self._harmonics = _harmonic_accessors(attributes)
            self.count = file.count(attributes["POSITION"])
            coefficients = len(self._harmonics)
        self.coefficients = 1 if self._is_linear else coefficients
        if any(file.count(number) != self.count for number in self._accessors()):
            raise ValueError("its attributes differ in length")

    def _accessors(self) -> Iterator[int]:
        """Yield the accessors that are read."""
        if self._packed is None:
            names = ("POSITION", *(f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY")))
            yield from (self._attributes[name] for name in names)
            yield from self._harmonics
        for own in self._channels.values():
            yield from own

    def blocks(self) -> Iterator[tuple[slice, GaussianCloud]]:
        """Yield all Gaussians in the world frame."""
        if self._packed is not None:
            found = iter(decode(self._packed).blocks)
        else:
            found = ((rows, self._read_rows(rows)) for rows in row_slices(self.count))
        for rows, cloud in found:
            assert isinstance(rows, slice)
            if self._is_linear:
                cloud = replace(cloud, sh=sh0_from_rgb(linear_to_srgb(0.5 + SH_C0 * cloud.sh[:, 0])))
            cloud = replace(cloud, notes=(*self._color_notes, *cloud.notes))
            named = {
                name: np.concatenate([self._file.array(k, np.float32, rows) for k in own], axis=1)
                for name, own in self._channels.items()
            }
            yield rows, replace(_to_world(self._path, cloud, self._matrix), channels=Channels(named))

    def _read_rows(self, rows: slice) -> GaussianCloud:
        """Return some Gaussians in the frame of the primitive."""
        attributes = self._attributes

        def read(semantic: str) -> np.ndarray:
            return self._file.array(attributes[semantic], np.float32, rows)

        xyzw = read(f"{EXTENSION}:ROTATION")
        sh = np.stack([self._file.array(k, np.float32, rows) for k in self._harmonics], axis=1)
        # Opacities of 0 and 1 have infinite logits, which flatten() replaces.
        with np.errstate(divide="ignore", invalid="ignore"):
            opacity = read(f"{EXTENSION}:OPACITY")[:, 0].astype(np.float64)
            logits = np.log(opacity) - np.log1p(-opacity)
            log_scales = np.log(read(f"{EXTENSION}:SCALE"))
        return GaussianCloud(
            means_world=read("POSITION"),
            quats_wxyz=np.ascontiguousarray(xyzw[:, [3, 0, 1, 2]]),
            log_scales=log_scales,
            opacity_logits=logits.astype(np.float32),
            sh=sh,
            notes=self._notes,
        )


def _color_notes(color_space: object) -> tuple[str, ...]:
    """Return what to tell of the color space that a file states; nothing of the usual one."""
    if color_space == LINEAR_COLOR_SPACE:
        return ("Its colors are linear; they were converted, without what depends on the view.",)
    if color_space != COLOR_SPACE:  # as in drafts of the extension
        return (f"Its color space {color_space} is not known; its colors were taken for {COLOR_SPACE}.",)
    return ()


def _sh_degree_of(attributes: dict[str, int]) -> int:
    """Return the highest degree of which there are coefficients."""
    found = (re.fullmatch(rf"{EXTENSION}:SH_DEGREE_(\d+)_COEF_0", name) for name in attributes)
    return max((int(match[1]) for match in found if match), default=0)


def _harmonic_accessors(attributes: Mapping[str, int]) -> list[int]:
    """Return the accessors of the coefficients, up to the highest degree that is complete."""
    bands: list[int] = []
    for degree in range(MAX_SH_DEGREE + 1):
        names = [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{place}" for place in range(2 * degree + 1)]
        if not all(name in attributes for name in names):
            break
        bands.extend(attributes[name] for name in names)
    if not bands:
        raise KeyError(f"{EXTENSION}:SH_DEGREE_0_COEF_0")
    return bands


def _to_world(path: Path, cloud: GaussianCloud, matrix: Float64[np.ndarray, "4 4"]) -> GaussianCloud:
    """Return the cloud in the world frame: its node's transform, then the half turn to y down."""
    if not np.array_equal(matrix, np.eye(4)):
        cloud = _apply_node_transform(path, cloud, matrix)
    return half_turn_gaussians(cloud)


def _apply_node_transform(
    path: Path, cloud: GaussianCloud, matrix: Float64[np.ndarray, "4 4"]
) -> GaussianCloud:
    linear = matrix[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    # A map that mirrors has a negative determinant.
    if not scale > 0 or np.abs(linear @ linear.T / scale**2 - np.eye(3)).max() > SIMILARITY_TOLERANCE:
        raise SceneFileError(f"{path}: a node mirrors its splats or scales them unevenly; apply it first.")
    means = cloud.means_world.astype(np.float64) @ linear.T + matrix[:3, 3]
    return replace(
        turn_cloud(cloud, linear / scale),
        means_world=means.astype(np.float32),
        log_scales=(cloud.log_scales + np.log(scale)).astype(np.float32),
        min_log_scale=cloud.min_log_scale + float(np.log(scale)),
    )


def _recognises(head: bytes) -> bool:
    return head.startswith(b"glTF")


register(
    Importer(
        "khr-glb",
        ("*.glb",),
        "glTF points with KHR_gaussian_splatting",
        read,
        _recognises,
        read_blocks=_read_blocks,
        holds_channels=True,
    )
)
