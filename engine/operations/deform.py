"""``deform``: a scene that follows a coarse mesh."""

import math
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field, PlainSerializer

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.events import EventListener, ignore_events
from octasplat.engine.core.local_origin import Origin
from octasplat.engine.core.threads import use_threads
from octasplat.engine.edit.axes import AXIS_ROTATIONS, Axes, default_axes
from octasplat.engine.edit.reports import DeformReport
from octasplat.engine.files import ImportedMesh, read_mesh, read_metadata
from octasplat.engine.files.glb_container import is_half_turned
from octasplat.engine.operations.base import (
    Operation,
    Options,
    ScenesWritten,
    never_stop,
    options_of,
    stop_if,
)
from octasplat.engine.operations.file_patterns import expand_patterns
from octasplat.engine.operations.sequence_request import SequenceRequest
from octasplat.engine.settings.fields import InputFile, Spelling, Unit

if TYPE_CHECKING:
    from octasplat.engine.edit.proxy import Binding, Proxy

_Length = Annotated[
    float, PlainSerializer(lambda value: value if math.isfinite(value) else "inf", when_used="json")
]
"""JSON has no infinity, so that it is a text there."""


class DeformOptions(Options):
    """Options of which mesh deforms the scene, and which parts of it."""

    proxy: InputFile = Field(
        description="The mesh at rest (.ply, .obj or .glb), lying on or around what is to move."
    )
    deformed: Annotated[tuple[InputFile, ...], Spelling(metavar="MESH")] = Field(
        min_length=1,
        max_length=10_000,
        description="The same mesh deformed; several, or here a quoted pattern such as 'frames/*.obj', are a "
        "sequence.",
    )
    method: Literal["nearest", "mvc"] = Field(
        "nearest",
        description="nearest: follow the triangles close by; mvc: mean-value coordinates of a closed cage.",
    )
    reach: Annotated[_Length | None, Spelling(metavar="LENGTH"), Unit("scene units")] = Field(
        None,
        ge=0.0,
        description="Follow fully up to this distance from the mesh, and not at all beyond twice of it; inf "
        "for everything.  [default: nearest: a tenth of the mesh's diagonal; mvc: inside of the cage]",
    )
    axes: Literal["auto"] | Axes = Field(
        "auto",
        description="Turn of both meshes about x, in degrees, that brings them to the scene's axes: auto is "
        "x180 where octasplat wrote the proxy as GLB, which is y up, else x0; x90 is for what Blender saves "
        "as OBJ or GLB beside a scene imported as PLY.",
    )
    mirrored: Literal["auto", "yes", "no"] = Field(
        "auto",
        description="Whether the deformed mesh was mirrored; auto looks at it, which a flat mesh cannot "
        "show.",
    )


class DeformRequest(DeformOptions, SequenceRequest):
    """Let the scene follow a coarse mesh, as an artist or a physics engine deformed it."""


class DeformResult(ScenesWritten):
    """A scene for each deformed mesh.

    Attributes:
        moving: number of Gaussians that are near enough to the mesh to move.
        count: number of Gaussians of the source.
        reports: what each deformation did.
    """

    moving: int
    count: int
    reports: tuple[DeformReport, ...]


def run(
    request: DeformRequest,
    *,
    progress: EventListener = ignore_events,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> DeformResult:
    """Bind the scene to a mesh at rest and move it; see :class:`octasplat.engine.operations.base.Run`.

    Raises:
        OctasplatError: something cannot be read or written, or the meshes are not the same one.
    """
    from octasplat.engine.edit.deform import deform_to, deformation_corners
    from octasplat.engine.operations.scene_io import describe_edit, open_scene
    from octasplat.engine.operations.sequences import SceneSequence

    use_threads(threads)
    source: Path = request.source
    paths = expand_patterns(request.deformed)
    frames = SceneSequence("deform", request, paths, [request.proxy])
    gaussians, origin = open_scene(source, progress), read_metadata(source).origin_world
    rest = read_mesh(request.proxy).about(origin)
    axes = _axes_of_meshes(request)
    # Gaussians follow the corners of their octagons
    corners = deformation_corners(gaussians)
    binding = _bind_scene(request, _make_proxy(request, rest, axes), corners)
    moving, count = int(binding.moving_mask.sum()), len(gaussians)
    note = describe_edit("deform", options_of(DeformOptions, request))
    reports, notes = [], [f"{request.proxy}: moves {moving:,} of {count:,} Gaussians."]
    if axes != "x0" and request.axes == "auto":
        notes.append(
            f"  meshes turned by {axes}, as octasplat wrote that one along the axes of glTF (--axes)"
        )
    for number, path in enumerate(paths):
        vertices = _rotate_mesh(_check_same_mesh(path, request.proxy, rest, origin), axes)
        result, report = deform_to(
            gaussians, corners, binding.deform(vertices), binding.mirrored_mask(vertices)
        )
        stop_if(should_stop)
        notes += [*_report_text(path, report), frames.write(number, result, progress, note)]
        reports.append(report)
        frames.report(number, progress)
    frames.write_report([{"deformed": str(path)} for path in paths], map(asdict, reports))
    return DeformResult(
        files=frames.files,
        folder=frames.folder,
        notes=tuple(notes),
        moving=moving,
        count=count,
        reports=tuple(reports),
    )


def _axes_of_meshes(request: DeformRequest) -> Axes:
    """Return the turn of the meshes; where nobody says it, that of a GLB of ours, or none."""
    if request.axes != "auto":
        return request.axes
    is_turned = request.proxy.suffix.lower() == ".glb" and is_half_turned(request.proxy)
    return default_axes(request.proxy) if is_turned else "x0"


def _make_proxy(request: DeformRequest, rest: ImportedMesh, axes: Axes) -> "Proxy":
    from octasplat.engine.edit.proxy import Proxy

    mirrored = {"auto": None, "yes": True, "no": False}[request.mirrored]  # None: the deformed mesh shows it
    try:
        return Proxy(_rotate_mesh(rest, axes), rest.triangles, mirrored)
    except SceneFileError as error:
        raise SceneFileError(f"{request.proxy}: {error}") from None


def _bind_scene(request: DeformRequest, proxy: "Proxy", corners: Float64[np.ndarray, "n 8 3"]) -> "Binding":
    from octasplat.engine.edit.proxy import bind_corners

    try:
        binding = bind_corners(proxy, corners, request.method, request.reach)
    except SceneFileError as error:
        raise SceneFileError(f"{request.proxy}: {error}") from None
    if not binding.moving_mask.any():
        raise SceneFileError(
            f"{request.proxy}: no Gaussian is near enough to be moved; if the proxy was saved along other "
            "axes, as Blender does for OBJ and GLB, say --axes x90, else widen --reach."
        )
    return binding


def _check_same_mesh(path: Path, proxy: Path, rest: ImportedMesh, origin: Origin) -> ImportedMesh:
    mesh = read_mesh(path).about(origin)
    if len(mesh) != len(rest) or not _has_same_faces(mesh, rest):
        raise SceneFileError(
            f"{path}: is not the mesh {proxy} with vertices moved; both need the same vertices and faces in "
            "the same order."
        )
    return mesh


def _rotate_mesh(mesh: ImportedMesh, axes: Axes) -> Float64[np.ndarray, "v 3"]:
    turned: Float64[np.ndarray, "v 3"] = mesh.vertices @ AXIS_ROTATIONS[axes].T
    return turned


def _has_same_faces(one: ImportedMesh, other: ImportedMesh) -> bool:
    """Return whether the same vertices make triangles; some programs flip those of a mirrored mesh."""
    if one.triangles.shape != other.triangles.shape:
        return False
    if np.array_equal(one.triangles, other.triangles):
        return True
    # the same vertices in any order, so that flipped triangles count as the same
    first, second = (np.sort(mesh.triangles, axis=1) for mesh in (one, other))
    return np.array_equal(first[np.lexsort(first.T)], second[np.lexsort(second.T)])


def _report_text(path: Path, report: DeformReport) -> list[str]:
    """Return a report in words."""
    lines = [
        f"{path}: {report.moved:,} Gaussians moved; distance from an affine map, in standard deviations: "
        f"median {report.residual_median:.2g}, 95th percentile {report.residual_p95:.2g}, "
        f"largest {report.residual_max:.2g}."
    ]
    if report.mirrored:
        lines.append(f"  {report.mirrored:,} mirrored with the proxy")
    if report.collapsed:
        lines.append(f"  {report.collapsed:,} lost their area and were only placed")
    return lines


OPERATION = Operation(
    "deform", "Make a scene follow a deformed cage or coarse mesh.", DeformRequest, DeformOptions, run
)
