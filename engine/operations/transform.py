"""``transform``: move, rotate and scale a scene."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field, FiniteFloat, WrapValidator, model_validator

from octasplat.engine.core.events import EventListener, ignore_events
from octasplat.engine.core.georeference import Georeference
from octasplat.engine.gaussians.scene_metadata import SceneMetadata
from octasplat.engine.operations.axes import Axis
from octasplat.engine.operations.base import (
    Operation,
    Options,
    SceneRequest,
    ScenesWritten,
    emit_warning,
    never_stop,
    options_of,
    stop_if,
)
from octasplat.engine.settings.fields import InputFile, Spelling, Unit

_Point = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
_Row = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
_Rows = tuple[_Row, _Row, _Row] | tuple[_Row, _Row, _Row, _Row]


def _checked_matrix(value: Any, handler: Callable[[Any], Any]) -> Any:
    """Return a path as such, and numbers as rows; refuses what is no affine matrix, in one sentence."""
    if value is None or isinstance(value, str | Path):
        return handler(value)
    try:
        rows = np.array(value, np.float64)
    except (TypeError, ValueError):
        raise ValueError(
            "must be a 4 x 4 or 3 x 4 matrix of numbers, or the path of a text file with one"
        ) from None
    if rows.shape not in ((4, 4), (3, 4)):
        shape = " x ".join(map(str, rows.shape)) or "a single number"
        raise ValueError(
            f"must be a 4 x 4 or 3 x 4 matrix, or the path of a text file with one; what is given is {shape}"
        )
    if not np.isfinite(rows).all():
        raise ValueError("must have finite numbers only")
    if len(rows) == 4 and not np.array_equal(rows[3], [0.0, 0.0, 0.0, 1.0]):
        raise ValueError("must have the last row 0 0 0 1: it maps columns (x, y, z, 1) to new ones")
    return handler(tuple(map(tuple, rows.tolist())))


class TransformOptions(Options):
    """The transforms, applied in this order: matrix, up, scale, rotate (repeatable), translate."""

    matrix: Annotated[InputFile | _Rows | None, WrapValidator(_checked_matrix), Spelling(metavar="FILE")] = (
        Field(
            None,
            description="An affine 4 x 4 or 3 x 4 matrix that maps old points to new ones, row by row: a "
            "text file or, in Python and JSON, its rows.",
        )
    )
    up: Annotated[tuple[Axis, Axis] | None, Spelling(metavar="OLD NEW")] = Field(
        None,
        description="Turn the axis that points up to another: -y z from COLMAP's usual frame to Blender's.",
    )
    scale: FiniteFloat | None = Field(None, description="Scale by a factor.")
    rotate: Annotated[
        tuple[tuple[Literal["x", "y", "z"], FiniteFloat], ...],
        Spelling(metavar="AXIS DEGREES"),
        Unit("degrees"),
    ] = Field(
        (),
        max_length=100,
        description="Turn about an axis, counter-clockwise seen from its tip; may be repeated.",
    )
    translate: Annotated[_Point | None, Unit("scene units")] = Field(None, description="Move.")
    about: Annotated[_Point, Unit("scene units")] = Field(
        (0.0, 0.0, 0.0), description="The point that up, scale and rotate leave where it is."
    )

    @model_validator(mode="after")
    def _does_something(self) -> "TransformOptions":
        requested = (self.matrix, self.up, self.scale, self.rotate or None, self.translate)
        if all(value is None for value in requested):
            raise ValueError("Say what to do: `matrix`, `up`, `scale`, `rotate` or `translate`")
        return self

    def world_map(self) -> Float64[np.ndarray, "4 4"]:
        """Return the 4 x 4 matrix from the old world to the new one.

        Raises:
            ConfigError: the file of the matrix cannot be read.
        """
        from octasplat.engine.gaussians import affine

        turns = np.eye(4)
        if self.up is not None:
            turns = affine.between_axes(*self.up)
        if self.scale is not None:
            turns = affine.scaling(np.full(3, self.scale)) @ turns
        for axis, degrees in self.rotate:
            turns = affine.rotation(affine.AXES[axis], degrees) @ turns
        # about the point: moved to the origin, turned, moved back
        combined = affine.conjugate_by_point(turns, np.array(self.about))
        if self.matrix is not None:
            matrix = self.matrix
            combined = combined @ (
                affine.read_matrix(matrix)
                if isinstance(matrix, Path)
                else affine.whole_matrix(np.array(matrix, np.float64))
            )
        if self.translate is not None:
            combined = affine.translation(np.array(self.translate)) @ combined
        return combined


class TransformRequest(TransformOptions, SceneRequest):
    """Move, turn, scale or shear the scene, its view-dependent colors included.

    Done in this order: matrix, up, scale, rotate as often as given, translate. The cameras and the learnt
    light of a run go along where they can.
    """


class TransformResult(ScenesWritten):
    """The transformed scene.

    Attributes:
        matrix: the affine map from the old world to the new one, row by row.
        count: number of Gaussians.
    """

    matrix: tuple[tuple[float, ...], ...]
    count: int


def run(
    request: TransformRequest,
    *,
    progress: EventListener = ignore_events,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> TransformResult:
    """Move, turn, scale or shear a scene; see :class:`octasplat.engine.operations.base.Run`.

    Raises:
        ConfigError: the matrix cannot be read or flattens space.
        SceneFileError: the scene cannot be read or written.
    """
    from octasplat.engine.core.local_origin import local_map, origin_after
    from octasplat.engine.files import read_metadata
    from octasplat.engine.gaussians.affine import mean_scale, transform_gaussians
    from octasplat.engine.operations import scene_io

    source: Path = request.source
    read = [request.matrix] if isinstance(request.matrix, Path) else []
    scene_io.check_edited_output("transform", request, request.output, read)
    matrix = request.world_map()
    scene, facts = scene_io.open_scene(source, progress), read_metadata(source)
    # of a scene far from the world's origin positions need another local one
    size = mean_scale(matrix) * float(np.median(scene.scales))
    origin = origin_after(matrix, scene.means_world, facts.origin_world, size)
    local = local_map(matrix, facts.origin_world, origin)
    moved = transform_gaussians(scene, local)
    stop_if(should_stop)
    rows = tuple(map(tuple, matrix.tolist()))
    written = scene_io.write_edited_scene(
        source,
        moved,
        request.output,
        progress,
        edit_record={
            **scene_io.describe_edit("transform", options_of(TransformOptions, request)),
            "world_map": rows,
        },
        # distances scale with the world, the origin is that after the map
        facts=replace(
            facts.scaled(mean_scale(matrix)),
            origin_world=origin,
            georeference=_moved(facts, matrix, progress),
        ),
        matrix=local,
    )
    return TransformResult(
        files=written.files, folder=written.folder, notes=(written.sentence,), matrix=rows, count=len(moved)
    )


def _moved(
    facts: SceneMetadata, matrix: Float64[np.ndarray, "4 4"], progress: EventListener
) -> Georeference | None:
    """Return the georeference of a scene after a map of it; a warning says where it is lost."""
    if facts.georeference is None:
        return None
    moved = facts.georeference.after(matrix)
    if moved is None:
        emit_warning(
            progress,
            "The georeference is left out, as the scene was mirrored, sheared or scaled unevenly.",
        )
    return moved


OPERATION = Operation("transform", "Move, turn or scale a scene.", TransformRequest, TransformOptions, run)
