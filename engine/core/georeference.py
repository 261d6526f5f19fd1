"""Georeference of a scene: the similarity from its coordinates to metres, and where these lie.

It describes a scene without changing it. The metres are along x east, y north and z up about an anchor near
the scene, so that 32 bits hold them; where nothing tells what is north, x and y are level, and there is no
anchor.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float, Float64
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.writing import write_text

GEOREFERENCE_FILE = "georeference.json"
"""Beside the scene of a run."""
WGS84 = "EPSG:4979"
"""Latitude and longitude in degrees, and height above the ellipsoid in metres."""
TOLERANCE = 1e-6
"""Of the scale: how far a matrix may be from a similarity."""
ROUNDING = 1e-12
"""Of the largest number of a matrix: formats that turn a scene keep its matrix as well as this."""

_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Row = tuple[_Finite, _Finite, _Finite, _Finite]


class _FrozenModel(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Residuals(_FrozenModel):
    """How well given positions fit a scene.

    Attributes:
        given: number of positions.
        used: those that agree with each other; the others were left out.
        rmse_m: root mean square of the distances of those used, metres.
        worst: name of the position used that is farthest off.
        worst_m: its distance, metres.
        left_out: names of those left out, the farthest first.
    """

    given: int
    used: int
    rmse_m: _Finite
    worst: str
    worst_m: _Finite
    left_out: tuple[str, ...] = ()


class Georeference(_FrozenModel):
    """Where a scene lies, how large it is, and what is up.

    Attributes:
        crs: EPSG code of the anchor's coordinates; None without an anchor.
        anchor: position in ``crs`` that the metres are about: latitude, longitude and height for
            :data:`WGS84`, else easting, northing and height.
        matrix: the upper three rows of the similarity from the user's coordinates of the scene (its local
            origin added) to metres about the anchor.
        method: what it was found by; empty where a file does not say.
        residuals: of the positions that it was found by; None where it was found otherwise.
    """

    format: Literal[1] = 1
    method: str = ""
    crs: str | None = Field(None, pattern=r"^EPSG:[0-9]{4,6}$")
    anchor: tuple[_Finite, _Finite, _Finite] | None = None
    matrix: tuple[_Row, _Row, _Row]
    residuals: Residuals | None = None

    @model_validator(mode="after")
    def _is_consistent(self) -> "Georeference":
        if (self.crs is None) != (self.anchor is None):
            raise ValueError("an anchor goes with the EPSG code of its coordinates")
        if not is_similarity(self.metres_from_scene):
            raise ValueError("the matrix is no similarity")
        return self

    @property
    def metres_from_scene(self) -> Float64[np.ndarray, "4 4"]:
        """Return the similarity as a matrix of homogeneous coordinates."""
        return np.array([*self.matrix, (0.0, 0.0, 0.0, 1.0)], np.float64)

    @property
    def metres_per_unit(self) -> float:
        """Return how many metres one unit of the scene is."""
        return similarity_scale(self.metres_from_scene)

    def after(self, matrix: Float[np.ndarray, "4 4"]) -> "Georeference | None":
        """Return the georeference of a scene that ``matrix`` moved; None where that was no similarity.

        Args:
            matrix: affine map of user coordinates from the old scene to the new one.
        """
        if not is_similarity(matrix):
            return None
        moved = self.metres_from_scene @ np.linalg.inv(np.asarray(matrix, np.float64))
        return self.model_copy(update={"matrix": matrix_rows(moved)})

    def is_same_place(self, other: "Georeference") -> bool:
        """Return whether another georeference says the same, but for rounding of files."""
        one, two = np.array(self.matrix), np.array(other.matrix)
        tolerance = ROUNDING * float(np.abs(one).max())
        is_close = bool(np.allclose(one, two, rtol=0, atol=tolerance))
        return is_close and (self.crs, self.anchor) == (other.crs, other.anchor)

    def describe(self) -> str:
        """Return scale and place in a few words, e.g. for a report."""
        scale = f"1 unit is {self.metres_per_unit:.6g} m"
        if self.anchor is None:
            return f"{scale}; no place on the Earth"
        digits = (".8f", ".8f", ".3f") if self.crs == WGS84 else (".3f", ".3f", ".3f")
        place = ", ".join(format(value, form) for value, form in zip(self.anchor, digits, strict=True))
        return f"{scale}; east, north and up about {self.crs} {place}"

    def facts(self) -> list[str]:
        """Return what is known in short statements: scale and place, and how well positions fit."""
        by = f" by {self.method}" if self.method else ""
        found = [f"georeference{by}: {self.describe()}"]
        if (fit := self.residuals) is not None:
            left = f", left out {_some_names(fit.left_out)}" if fit.left_out else ""
            found.append(
                f"{fit.used} of {fit.given} positions fit with an RMSE of {fit.rmse_m:.3g} m, the worst "
                f"{fit.worst} by {fit.worst_m:.3g} m{left}"
            )
        return found


def _some_names(names: tuple[str, ...]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")


def matrix_rows(matrix: Float[np.ndarray, "4 4"]) -> tuple[_Row, _Row, _Row]:
    """Return the upper three rows of a matrix as a georeference keeps them."""
    first, second, third = (tuple(row) for row in np.asarray(matrix, np.float64)[:3].tolist())
    return first, second, third


def similarity_scale(matrix: Float[np.ndarray, "4 4"]) -> float:
    """Return the scale of a similarity; 0 or less of what mirrors or flattens."""
    return float(np.cbrt(np.linalg.det(np.asarray(matrix, np.float64)[:3, :3])))


def is_similarity(matrix: Float[np.ndarray, "4 4"]) -> bool:
    """Return whether an affine map consists of rotation, translation and uniform scale."""
    linear = np.asarray(matrix, np.float64)[:3, :3]
    scale = similarity_scale(matrix)
    return scale > 0 and bool(
        np.allclose(linear @ linear.T, scale**2 * np.eye(3), rtol=0, atol=TOLERANCE * scale**2)
    )


def write_georeference(path: Path, georeference: Georeference) -> None:
    """Write a georeference as JSON, atomically.

    Raises:
        OSError: the file cannot be written.
    """
    write_text(path, json.dumps(georeference.model_dump(mode="json"), indent=2) + "\n")


def read_georeference(path: Path) -> Georeference | None:
    """Return the georeference in a file; None where there is no file.

    Raises:
        ConfigError: it cannot be read.
    """
    try:
        return Georeference.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValidationError) as error:
        reason = str(error).splitlines()[-1].strip() if isinstance(error, ValidationError) else error
        raise ConfigError(
            f"{path} cannot be read ({reason}); delete it to go on without a georeference."
        ) from None


_CRS, _ANCHOR, _MATRIX = "georeference_crs", "georeference_anchor", "georeference_matrix"


def georeference_comments(georeference: Georeference | None) -> list[str]:
    """Return the comments of a text or a PLY that say a georeference; none without one.

    The matrix is in rows, and for the user's coordinates, those of the file with the local origin added.
    """
    if georeference is None:
        return []
    matrix = " ".join(repr(value) for row in georeference.matrix for value in row)
    if georeference.anchor is None:
        return [f"{_MATRIX} {matrix}"]
    anchor = " ".join(map(repr, georeference.anchor))
    return [f"{_CRS} {georeference.crs}", f"{_ANCHOR} {anchor}", f"{_MATRIX} {matrix}"]


def parse_georeference(comments: Mapping[str, str]) -> Georeference | None:
    """Return the georeference that comments say, by their first words; None where there is none.

    Raises:
        ValueError: they say nonsense.
    """
    if _MATRIX not in comments:
        return None
    values = [float(text) for text in comments[_MATRIX].split()]
    if len(values) != 12:
        raise ValueError(f"{_MATRIX} has {len(values)} numbers instead of 12")
    matrix = np.vstack([np.reshape(values, (3, 4)), (0.0, 0.0, 0.0, 1.0)])
    content: dict[str, object] = {"matrix": matrix_rows(matrix)}
    if _ANCHOR in comments:
        content |= {"crs": comments.get(_CRS), "anchor": [float(x) for x in comments[_ANCHOR].split()]}
    return Georeference.model_validate(content)
