"""``surface``: one colored triangle mesh of a scene, in one or several levels of detail."""

import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import (
    BeforeValidator,
    Field,
    TypeAdapter,
    ValidationError,
    field_validator,
    model_validator,
)

from octasplat.engine.core.errors import OutputError
from octasplat.engine.core.events import EventListener, ignore_events
from octasplat.engine.operations.axes import Axis, light_up
from octasplat.engine.operations.base import Operation, Options, Result, WritingRequest, never_stop
from octasplat.engine.settings import renamed_settings
from octasplat.engine.settings.fields import DatasetFolder, Output, Source, Spelling
from octasplat.engine.surface.options import ExtractionOptions

if TYPE_CHECKING:
    from octasplat.engine.surface.color_fit import Picture
    from octasplat.engine.surface.extract import ExtractedSurface

MATERIAL_DEFAULTS: Mapping[str, object] = {"texture_size": 1024, "max_triangles": 60_000}
"""With materials, where nothing else is said."""

ROOM_DEFAULTS: Mapping[str, object] = {
    "unbounded": True,
    "unseen": "solid",
    "backdrop": True,
    "resolution": 720,
    "truncation": 3.0,
    "min_weight": 0.3,
    "depth_side": 320,
    "refine_vertices": True,
}
"""What suits pictures of a room, measured on one; see docs/surface.md."""

_FACTORS = {"": 1, "k": 1000, "M": 1_000_000}


def _parse_triangle_count(text: str) -> int:
    """Return the number of a text such as ``60000`` or ``60k``; 0 if it is none."""
    written = re.fullmatch(r"(\d+(?:\.\d+)?)([kM]?)", text)
    return round(float(written[1]) * _FACTORS[written[2]]) if written else 0


def _read_levels(value: object) -> object:
    """Return numbers of triangles as texts: those of a text with commas, or of one or several numbers."""
    parts = value.split(",") if isinstance(value, str) else value
    if parts is None:
        return ()
    texts = [str(part).strip() for part in (parts if isinstance(parts, list | tuple) else [parts])]
    counts: list[int] = []
    for text in texts:
        count = _parse_triangle_count(text)
        if not 4 <= count < 1 << 31:
            raise ValueError(f"{text!r} is no number of triangles from 4 on, such as 60000 or 50k")
        if count in counts:
            raise ValueError(f"{text!r} is there twice")
        counts.append(count)
    return tuple(texts)


def _is_on(value: object) -> bool:
    try:
        return TypeAdapter(bool).validate_python(value)
    except ValidationError:
        return False  # which is told where the field itself is read


class SurfaceOptions(ExtractionOptions, Options):
    """Options of how the surface of a scene is meshed and colored."""

    former_names: ClassVar[renamed_settings.FormerNames] = renamed_settings.EXTRACTION

    room: bool = Field(
        False,
        description="What pictures of a room need, where nothing else is said: unbounded (not with a box), "
        "unseen solid, backdrop, refine_vertices, and finer voxels than a box has.",
    )
    max_triangles: Annotated[
        tuple[str, ...],
        Spelling(metavar="N[,N...]"),
        BeforeValidator(_read_levels, json_schema_input_type=str | int | tuple[str | int, ...] | None),
    ] = Field(
        (),
        max_length=20,
        description="Decimate to so many triangles, such as 60000 or 60k; 5k,50k,500k writes a file each, "
        "NAME_5k.glb.  [default: all]",
    )
    materials: bool = Field(
        False,
        description="Base color, metallic, roughness and normals in textures, to be lit; .glb or .usdz. "
        "Takes 60,000 triangles and a texture of 1,024 pixels where nothing else is said.",
    )
    up: Axis | None = Field(
        None, description="With materials: the axis that points up.  [default: the run's, of a file -y]"
    )

    @model_validator(mode="before")
    @classmethod
    def _with_presets(cls, given: Any) -> Any:
        if not isinstance(given, Mapping):
            return given
        given = renamed_settings.replace_former_names((cls,), given)
        room = dict(ROOM_DEFAULTS) if _is_on(given.get("room", False)) else {}
        if given.get("box") is not None:
            room.pop("unbounded", None)  # which a box contradicts
        if given.get("voxel") is not None:
            room.pop("resolution", None)
        materials = MATERIAL_DEFAULTS if _is_on(given.get("materials", False)) else {}
        return {**room, **materials, **given}  # what is given wins over both presets

    @field_validator("up")
    @classmethod
    def _check_up(cls, up: Axis | None, info: Any) -> Axis | None:
        # unknown where materials is refused itself
        if up is not None and info.data.get("materials") is False:
            raise ValueError("goes with materials, and there are none")
        return up

    @property
    def levels(self) -> Mapping[str, int]:
        """Return the number of triangles of each level of detail, by its name; None keeps all triangles."""
        return {text: _parse_triangle_count(text) for text in self.max_triangles}


class SurfaceRequest(SurfaceOptions, WritingRequest):
    """Mesh IN, the folder of a run or a file of Gaussians, into one surface of colored triangles.

    Depth is rendered from where the photographs were taken; for a file without photographs, from cameras all
    around, which suits an object but no room. The result lies in the frame of the scene.

    With materials, environment.hdr of a run goes beside the file.
    """

    source: Source = Field(description="The scene to mesh: the folder of a run, or a file of any format.")
    output: Output = Field(description="A .glb, .ply, .obj or .usdz file.")
    dataset: DatasetFolder = Field(
        None,
        description="Take the cameras of the photographs in this folder, and of a run the colors.  "
        "[default: the cameras that a run keeps; else none]",
    )
    photographs: Annotated[Path | None, Spelling(hidden=True)] = Field(
        None,
        description="A copy of the photographs that the run was made from, for colors alone; left out if it "
        "has other poses.",
    )

    @property
    def outputs(self) -> tuple[Path, ...]:
        """Return the file of each level of detail."""
        if len(self.levels) < 2:
            return (self.output,)
        stem, suffix = self.output.stem, self.output.suffix
        return tuple(self.output.with_name(f"{stem}_{name}{suffix}") for name in self.levels)


class SurfaceLevel(Result):
    """The mesh of one level of detail.

    Attributes:
        files: the mesh, and the textures that lie beside it.
        triangles: number of its triangles.
        open_edges: number of edges with one triangle; a watertight mesh has none.
        is_watertight: whether each edge has two triangles that face the same way.
        voxel_world: side of a voxel, in scene units; at the centre of an unbounded surface.
        is_contracted: whether voxels grow with the distance from the centre.
        holes_closed: number of holes that were closed.
        volume_bytes: memory that the fused volume took.
    """

    triangles: int
    open_edges: int
    is_watertight: bool
    voxel_world: float
    is_contracted: bool
    holes_closed: int
    volume_bytes: int

    def lines(self) -> tuple[str, ...]:
        """Return facts on the mesh, and its files with their sizes."""
        closed = "watertight" if self.is_watertight else f"{self.open_edges:,} open edges"
        voxel = f"{self.voxel_world:.3g}{' at the centre' if self.is_contracted else ''}"
        holes = f", {self.holes_closed:,} holes closed" if self.holes_closed else ""
        volume = f"{self.volume_bytes / 1e6:,.0f} MB of volume"
        return (
            f"{self.triangles:,} triangles, {closed}; voxels of {voxel}, {volume}{holes}.",
            *_file_lines(self.files),
        )


class SurfaceResult(Result):
    """The meshes in the order of the levels of detail, and the environment beside them if they are lit.

    Attributes:
        levels: the meshes.
        environment: the environment map of a run with materials, if it was copied beside them.
    """

    levels: tuple[SurfaceLevel, ...]
    environment: Path | None = None

    def lines(self) -> tuple[str, ...]:
        """Return facts on the meshes, and all files with their sizes."""
        light = () if self.environment is None else _file_lines((self.environment,))
        return (*(line for level in self.levels for line in level.lines()), *light)


def run(
    request: SurfaceRequest,
    *,
    progress: EventListener = ignore_events,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> SurfaceResult:
    """Extract a surface and write it; see :class:`octasplat.engine.operations.base.Run`.

    Raises:
        ConfigError: the file's name does not fit or is that of the scene, or the region to mesh is empty or
            too large.
        OutputError: the source has no scene yet, or the place of the output cannot be used.
        SceneFileError: the scene cannot be read, or the mesh not be written.
        CancelledError: stopped as asked; nothing was written.
    """
    from octasplat.engine.core.local_origin import box_about
    from octasplat.engine.files import check_surface_path, read_metadata, surface_files, write_surface
    from octasplat.engine.gaussians.materials import require_materials
    from octasplat.engine.operations.scene_io import open_scene
    from octasplat.engine.operations.written_files import check_targets
    from octasplat.engine.runs.run_folder import SCENE, is_run
    from octasplat.engine.runs.surface_inputs import depth_cameras
    from octasplat.engine.runs.viewer_glb import upright_turn
    from octasplat.engine.shading.environment_frame import environment_frame
    from octasplat.engine.surface.bake_materials import material_features
    from octasplat.engine.surface.extract import extract_levels
    from octasplat.engine.trace.factory import make_tracer

    source, output = request.source, request.output
    is_textured = request.texture_size is not None
    check_surface_path(output, textured=is_textured, lit=request.materials)
    check_targets(
        "surface",
        [path for place in request.outputs for path in surface_files(place, textured=is_textured)],
        [source, request.dataset, request.photographs],
        overwrite=request.overwrite,
    )
    if is_run(source) and not (source / SCENE).exists():
        raise OutputError(
            f"{source} holds no {SCENE} yet; finish the run with octasplat reconstruct --resume."
        )
    gaussians, facts = open_scene(source, progress), read_metadata(source)
    features, frame, light = None, None, None
    if request.materials:
        require_materials(gaussians, source / SCENE if is_run(source) else source)
        features, frame = material_features(gaussians), environment_frame(light_up(source, request.up))
        light = _light_to_copy(source, output)  # refused before the long work if another one lies there
    cameras, settings = depth_cameras(source, request.dataset, gaussians, request.depth_side)
    turn = upright_turn(source, request.dataset)
    try:
        # the depth maps' file goes there, long before the surface
        output.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{output.parent} cannot be made ({error.strerror or error}).") from None
    tracer = make_tracer(settings, threads=threads, build_quality=2)
    tracer.build(gaussians, features)
    surfaces = extract_levels(
        tracer,
        cameras,
        # the box is given in the user's coordinates
        request.model_copy(update={"box": box_about(request.box, facts.origin_world)}),
        tuple(request.levels.values()) or (None,),
        scratch=output.parent,
        light_frame=frame,
        photographs=_fit_photographs(request, threads, progress),
        listener=progress,
        should_stop=should_stop,
    )
    place: dict[str, Any] = {"origin_world": facts.origin_world, "georeference": facts.georeference}
    levels = tuple(
        _surface_level(surface, write_surface(replace(surface.mesh, **place), path, turn))
        for surface, path in zip(surfaces, request.outputs, strict=True)
    )
    environment = None if light is None else _copy_light(light, output)
    files = (*(path for level in levels for path in level.files), *([environment] if environment else []))
    return SurfaceResult(files=files, folder=output.parent, levels=levels, environment=environment)


def _fit_photographs(request: SurfaceRequest, threads: int, progress: EventListener) -> "tuple[Picture, ...]":
    from octasplat.engine.runs.surface_inputs import training_photographs

    if not request.fit:
        return ()
    return training_photographs(request.source, request.dataset, threads, progress, copy=request.photographs)


def _surface_level(extracted: "ExtractedSurface", files: tuple[Path, ...]) -> SurfaceLevel:
    return SurfaceLevel(
        files=files,
        triangles=len(extracted.mesh.faces),
        open_edges=extracted.edges.open_edges,
        is_watertight=extracted.edges.is_watertight,
        voxel_world=extracted.region.voxel_world,
        is_contracted=extracted.region.contracted,
        holes_closed=extracted.holes_closed,
        volume_bytes=extracted.volume_bytes,
    )


def _file_lines(files: tuple[Path, ...]) -> tuple[str, ...]:
    return tuple(f"Wrote {path} ({path.stat().st_size / 1e6:.1f} MB)." for path in files)


def _light_to_copy(source: Path, output: Path) -> Path | None:
    """Return the run's environment, if it has one that is not beside the output already.

    Raises:
        OutputError: there is another one.
    """
    from octasplat.engine.runs.run_folder import ENVIRONMENT_HDR, is_run

    light, place = source / ENVIRONMENT_HDR, output.with_name(ENVIRONMENT_HDR)
    if not (is_run(source) and light.exists()):
        return None
    if not place.exists():
        return light
    # the same environment needs no copy
    if place.samefile(light) or place.read_bytes() == light.read_bytes():
        return None
    raise OutputError(
        f"{place} is another environment than that of {source}; remove it, or name a file elsewhere."
    )


def _copy_light(light: Path, output: Path) -> Path:
    """Copy the environment beside the output; return its new place."""
    from octasplat.engine.core.writing import atomic_replace

    place = output.with_name(light.name)
    try:
        with atomic_replace(place) as temporary:
            shutil.copyfile(light, temporary)
    except OSError as error:
        raise OutputError(f"{place} cannot be written ({error.strerror or error}).") from None
    return place


OPERATION = Operation("surface", "One colored triangle mesh of a scene.", SurfaceRequest, SurfaceOptions, run)
