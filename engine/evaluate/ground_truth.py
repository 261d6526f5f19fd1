"""``truth.json``: what is known of a rendered scene, read and checked.

docs/materials.md, "truth.json", tells the format.
It lies beside the scene, or beside the folder of the views whose truth it is.
"""

import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated

import numpy as np
import OpenImageIO as oiio
from jaxtyping import Bool, Float32, Float64
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from octasplat.engine.core.color import srgb_to_linear
from octasplat.engine.core.errors import ConfigError, DatasetError
from octasplat.engine.core.relative_paths import check_relative_path
from octasplat.engine.render.image_files import read_image, shrink_to

GROUND_TRUTH_FILE = "truth.json"
# v, then optionally /a, *b and +c or -c, in this order
_FORMULA = re.compile(r"\bv(?:/(\d+(?:\.\d+)?))?(?:\*(\d+(?:\.\d+)?))?([+-]\d+(?:\.\d+)?)?(?![\w*/+])")
_AXES = {f"{sign}{name}": k for k, name in enumerate("xyz") for sign in ("+", "-", "")}


def _check_formula(text: str) -> str:
    if _FORMULA.search(text) is None:
        raise ValueError("tells no formula of the stored value v, as v/255 or v/65535*8.0")
    return text


_Path = Annotated[str, AfterValidator(check_relative_path)]
_Formula = Annotated[str, AfterValidator(_check_formula)]


class _Part(BaseModel):
    """Further keys are for people to read."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class _World(_Part):
    up: str = "+z"

    @model_validator(mode="after")
    def _is_an_axis(self) -> "_World":
        if self.up not in _AXES:
            raise ValueError("up is one of +x, -x, +y, -y, +z, -z")
        return self


class _Environment(_Part):
    train: _Path | None = None
    relight: tuple[_Path, ...] = ()
    folder: _Path = "env"


class _Maps(_Part):
    folder: _Path = "test"
    truth_views: Annotated[tuple[_Path, ...], Field(min_length=1)]
    normal: _Formula | None = None
    depth: _Formula | None = None
    albedo: str | None = None
    roughness: _Formula | None = None
    metallic: _Formula | None = None


class _Relight(_Part):
    folders: tuple[_Path, ...] = ()
    views: tuple[_Path, ...] = ()


class GroundTruthFile(_Part):
    """The keys of ``truth.json`` that are read.

    Attributes:
        name: of the scene.
        world: which way is up.
        environment: names of the maps, the one of the photographs and those of relit pictures.
        test: maps of the truth by view.
        relight: pictures under other light.
    """

    name: str = ""
    world: _World = _World()
    environment: _Environment = _Environment()
    test: _Maps
    relight: _Relight = _Relight()


@dataclass(frozen=True)
class ViewGroundTruth:
    """Ground-truth maps of one view; None where a map is not available.

    Attributes:
        mask: where the scene is seen.
        normal_world: unit vectors that face the camera, 0 outside the mask.
        depth_z: along the camera's axis, world units, as in the file outside the mask.
        albedo_linear: base color.
        roughness: perceptual.
        metallic: share of the metal.
    """

    mask: Bool[np.ndarray, "h w"]
    normal_world: Float32[np.ndarray, "h w 3"] | None = None
    depth_z: Float32[np.ndarray, "h w"] | None = None
    albedo_linear: Float32[np.ndarray, "h w 3"] | None = None
    roughness: Float32[np.ndarray, "h w"] | None = None
    metallic: Float32[np.ndarray, "h w"] | None = None


@dataclass(frozen=True)
class GroundTruth:
    """A truth file and the folders beside it.

    Attributes:
        path: of ``truth.json``.
        content: its keys.
    """

    path: Path
    content: GroundTruthFile

    @property
    def views(self) -> tuple[str, ...]:
        """Return the names of the views with maps."""
        return self.content.test.truth_views

    @property
    def up_world(self) -> Float64[np.ndarray, "3"]:
        """Return the up axis in world coordinates, a unit vector."""
        up = self.content.world.up
        return (-1.0 if up.startswith("-") else 1.0) * np.eye(3)[_AXES[up]]

    @property
    def environment(self) -> Path | None:
        """Return the environment map that lit the photographs."""
        train = self.content.environment.train
        return None if train is None else self._environment_path(train)

    @property
    def relit_folders(self) -> tuple[tuple[Path, Path], ...]:
        """Return the folders of images under other light, each with its map."""
        root = self.path.parent
        return tuple(
            (root / folder, self._environment_path(PurePosixPath(folder).name))
            for folder in self.content.relight.folders
        )

    def relit_image(self, folder: Path, name: str, max_side_px: int) -> Float32[np.ndarray, "h w 4"]:
        """Return premultiplied display colors and coverage of a view under other light, downscaled.

        Raises:
            DatasetError: the picture is missing or damaged, or has no alpha.
        """
        image = read_image(folder / name)
        if image.shape[2] != 4:
            raise DatasetError(f"{folder / name} has no alpha, which tells the scene from what is behind it.")
        # Premultiplied before it is shrunk, so that colors of transparent pixels do not mix in
        image[..., :3] *= image[..., 3:]
        return shrink_to(image, max_side_px)

    def view(self, name: str, size: tuple[int, int]) -> ViewGroundTruth:
        """Return the ground-truth maps of a view.

        Args:
            name: of the view.
            size: height and width to have them at: those of the maps, or smaller ones in the same
                proportion, for which the nearest pixels are taken.

        Raises:
            DatasetError: a map that truth.json tells of is missing, damaged, or of another shape.
        """
        maps = self.content.test
        mask = self._stored_image("mask", name, size)[..., 0] > 0.5
        scalars = {
            kind: None if text is None else _decode(self._stored_image(kind, name, size)[..., 0], text)
            for kind, text in (
                ("depth", maps.depth),
                ("roughness", maps.roughness),
                ("metallic", maps.metallic),
            )
        }
        normal = albedo = None
        if maps.normal is not None:
            normal = _decode(self._stored_image("normal", name, size)[..., :3], maps.normal)
            # Values of few bits make vectors of not quite unit length.
            normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
            normal[~mask] = 0.0
        if maps.albedo is not None:
            albedo = srgb_to_linear(_bytes_to_unit_range(self._stored_image("albedo", name, size)[..., :3]))
        return ViewGroundTruth(
            mask=mask,
            normal_world=normal,
            depth_z=scalars["depth"],
            albedo_linear=albedo,
            roughness=scalars["roughness"],
            metallic=scalars["metallic"],
        )

    def _environment_path(self, name: str) -> Path:
        return self.path.parent / self.content.environment.folder / f"{name}.hdr"

    def _stored_image(self, kind: str, name: str, size: tuple[int, int]) -> Float64[np.ndarray, "h w c"]:
        """Return the stored values of a map at ``size``, by nearest pixels."""
        path = self.path.parent / self.content.test.folder / kind / name
        image = read_image(path)
        height, width = image.shape[:2]
        # The same proportions, up to the rounding of one side
        if abs(height * size[1] - width * size[0]) > max(height, width) or height < size[0]:
            raise DatasetError(
                f"{path} has {width} x {height} pixels, which does not suit the view's {size[1]} x {size[0]}."
            )
        rows = ((np.arange(size[0]) + 0.5) * height / size[0]).astype(int)
        columns = ((np.arange(size[1]) + 0.5) * width / size[1]).astype(int)
        # read_image() gives values from 0 to 1, formulas are of the stored integers.
        return image[rows[:, None], columns].astype(np.float64) * _integer_steps(path)


def find_ground_truth(folder: Path) -> GroundTruth | None:
    """Return the ground truth inside or beside a folder of photographs; None if there is none.

    Raises:
        ConfigError: the file is no truth in this format.
    """
    inside, beside = folder / GROUND_TRUTH_FILE, folder.resolve().parent / GROUND_TRUTH_FILE
    if inside.is_file():
        return read_ground_truth(inside)
    if beside.is_file():
        truth = read_ground_truth(beside)
        # One beside a folder counts only if the folder is that of its own views.
        if beside.parent / truth.content.test.folder == folder.resolve():
            return truth
    return None


def read_ground_truth(path: Path) -> GroundTruth:
    """Read and check a truth file; the maps are read when they are asked for.

    Raises:
        ConfigError: the file is missing, damaged, or says something that is not understood.
    """
    try:
        return GroundTruth(path, GroundTruthFile.model_validate_json(path.read_bytes()))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "content"
        # The prefix is pydantic's.
        raise ConfigError(f"{path}: {where}: {first['msg'].removeprefix('Value error, ')}.") from None
    except OSError as error:
        raise ConfigError(f"{path} cannot be read ({error.strerror}).") from None


def _decode(stored: Float64[np.ndarray, "*shape"], text: str) -> Float32[np.ndarray, "*shape"]:
    """Decode values by a formula in a sentence: v over a number, times one, plus one."""
    match = _FORMULA.search(text)
    assert match is not None
    by, times, plus = (
        float(group) if group else neutral for group, neutral in zip(match.groups(), (1, 1, 0), strict=True)
    )
    return (stored / by * times + plus).astype(np.float32)


def _bytes_to_unit_range(stored: Float64[np.ndarray, "*shape"]) -> Float32[np.ndarray, "*shape"]:
    return (stored / 255.0).astype(np.float32)


def _integer_steps(path: Path) -> float:
    """Return how many steps the file's integers have from 0 to 1; 1 for floating point."""
    kind = oiio.ImageBuf(str(path)).spec().format.basetype
    return {oiio.UINT8: 255.0, oiio.UINT16: 65535.0}.get(kind, 1.0)
