"""Compilation of a stage's meshes, lights and materials to arrays for path tracing."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from octasplat.engine.core.color import srgb_to_linear
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.local_origin import NO_ORIGIN, Origin
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.pathtracing.environment import EnvironmentMap, environment_frame
from octasplat.engine.pathtracing.imported_materials import ImportedMaterial, import_material
from octasplat.engine.pathtracing.kernels.kernel_args import (
    LightArrays,
    MaterialArrays,
    MeshQueries,
    MeshScene,
    SurfaceArrays,
)
from octasplat.engine.pathtracing.kernels.surface import GLASS
from octasplat.engine.pathtracing.lights import (
    EmissiveMesh,
    build_light_arrays,
    light_triangles,
    triangle_areas,
)
from octasplat.engine.pathtracing.material_table import MaterialTable
from octasplat.engine.pathtracing.mesh_files import MeshShape, count_open_edges, load_file_shape
from octasplat.engine.pathtracing.mesh_shapes import (
    corner_normals,
    primitive_shape,
    transform_normals,
    transform_points,
    turn_outwards,
    up_axis_rotation,
)
from octasplat.engine.pathtracing.stage.materials import Diffuse, Emissive, Glass
from octasplat.engine.pathtracing.stage.model import Stage, StageMesh
from octasplat.engine.render.environment_files import read_environment
from octasplat.engine.trace.triangle_bvh import TriangleBvh

SMOOTH_DEGREES = 30.0
WarnCallback = Callable[[str], None]


@dataclass(frozen=True)
class CompiledMeshes:
    """The meshes, lights and environment of a stage, ready to be traced.

    Attributes:
        surfaces: all triangles, those of visible lights included.
        triangles: what rays are sent through.
        covers: those without holes; None where none has any.
        obstacles: those without holes that are not of glass; None where all are.
        filters: those that are not obstacles, in the order of ``filter_faces``.
        filter_faces: rows in the surfaces.
        materials: of the triangles.
        lights: of the stage, with the meshes that shine; the environment is the last of them.
        environment_visible: whether the camera sees the environment.
    """

    surfaces: SurfaceArrays
    triangles: TriangleBvh
    materials: MaterialArrays
    lights: LightArrays
    environment_visible: bool
    covers: TriangleBvh | None = None
    obstacles: TriangleBvh | None = None
    filters: TriangleBvh | None = None
    filter_faces: Int64[np.ndarray, " g"] | None = None

    @property
    def queries(self) -> MeshQueries:
        """Return the kernels' Embree queries; valid while this object lives."""
        if self.obstacles is None or self.filters is None or self.filter_faces is None:
            every = self.triangles.any_query
            nothing = self.triangles.closest_query._replace(scene=0)
            return MeshQueries(
                self.triangles.closest_query, every, every, nothing, np.empty(0, np.int64), False
            )
        return MeshQueries(
            self.triangles.closest_query, (self.covers or self.triangles).any_query, self.obstacles.any_query,
            self.filters.closest_query, self.filter_faces, self.covers is not None,
        )  # fmt: skip

    @property
    def scene(self) -> MeshScene:
        """Return what the kernels know of the meshes and lights."""
        nested = bool((self.materials.priorities >= 0).any())
        return MeshScene(self.surfaces, self.materials, self.lights, self.lights.environment_id, nested)

    def with_lights(self, lights: LightArrays) -> "CompiledMeshes":
        """Return the same meshes with other lights and an environment that the camera does not see."""
        return replace(self, lights=lights, environment_visible=False)


def compile_meshes(
    stage: Stage,
    folder: Path,
    *,
    threads: int = 0,
    warn: WarnCallback = lambda _sentence: None,
    origin_world: Origin = NO_ORIGIN,
) -> CompiledMeshes:
    """Read and place everything of a stage except its Gaussians.

    Args:
        stage: whose meshes have no place in the scene left to be found (``on``).
        folder: where the stage's files are relative to.
        threads: for building and tracing; 0 takes all.
        warn: called with a sentence on what of a mesh file's materials is not understood, and on what of a
            file is mended.
        origin_world: local origin of the scene, about which meshes of files in large coordinates are put.

    Raises:
        ConfigError: a mesh of glass is not closed, one that shines has no area, or an image is none.
        SceneFileError: a mesh cannot be read.
    """
    up = np.array(stage.up)
    gathered = _MeshBuilder(MaterialTable(folder), len(stage.lights))
    for number, mesh in enumerate(stage.meshes):
        _add_mesh(
            builder=gathered,
            mesh=mesh,
            number=number,
            shape=load_mesh_shape(mesh, number, folder, origin_world),
            up=up,
            warn=warn,
        )
    for number, light in enumerate(stage.lights):
        corners = light_triangles(light, up)
        if corners is not None:
            row = gathered.table.add_light(number)
            gathered.add(corners, corner_normals(corners, 0.0), np.full(len(corners), row, np.int32))
    environment = None
    if stage.environment is not None:
        radiance = read_environment(folder / stage.environment.file, warn)
        environment = EnvironmentMap(
            radiance * np.float32(stage.environment.strength),
            environment_frame(np.array(stage.environment.up or stage.up), stage.environment.rotation_degrees),
        )
    surfaces, materials = gathered.surfaces(), gathered.table.arrays()
    lights = build_light_arrays(
        lights=stage.lights,
        up_world=up,
        environment=environment,
        meshes=gathered.emissive,
        texels_linear=materials.texels_linear,
        texture_sizes=materials.texture_sizes,
        found_by_paths=all(scene.shadows_on_meshes for scene in stage.gaussians),
    )
    points = surfaces.corners_world.reshape(-1, 3)
    faces = np.arange(len(points), dtype=np.int32).reshape(-1, 3)
    has_holes = (materials.opacity_textures >= 0) | (materials.opacities < 1.0)
    is_cutout = (has_holes | (materials.uses_vertex_alpha != 0))[surfaces.material_ids]
    is_filter = is_cutout | (materials.kinds[surfaces.material_ids] == GLASS)
    some = bool(is_filter.any())

    def hierarchy(rows: Int32[np.ndarray, "f 3"]) -> TriangleBvh:
        # Rays with random numbers meet no edge exactly, those through centres of pixels do.
        return TriangleBvh(points, rows, threads=threads, is_watertight=not stage.integrator.anti_aliasing)

    return CompiledMeshes(
        surfaces=surfaces,
        triangles=hierarchy(faces),
        materials=materials,
        lights=lights,
        environment_visible=stage.environment is not None and stage.environment.visible,
        covers=hierarchy(faces[~is_cutout]) if is_cutout.any() else None,
        obstacles=hierarchy(faces[~is_filter]) if some else None,
        filters=hierarchy(faces[is_filter]) if some else None,
        filter_faces=np.flatnonzero(is_filter) if some else None,
    )


@dataclass
class _MeshBuilder:
    """Accumulator of a stage's triangles; ``light_count`` counts the stage's own lights."""

    table: MaterialTable
    light_count: int
    corners: list[Float32[np.ndarray, "f 3 3"]] = field(default_factory=list)
    normals: list[Float32[np.ndarray, "f 3 3"]] = field(default_factory=list)
    uv: list[Float32[np.ndarray, "f 3 2"]] = field(default_factory=list)
    rows: list[Int32[np.ndarray, " f"]] = field(default_factory=list)
    rgb_linear: list[Float32[np.ndarray, "f 3 3"] | None] = field(default_factory=list)
    alpha: list[Float32[np.ndarray, "f 3"] | None] = field(default_factory=list)
    emissive: list[EmissiveMesh] = field(default_factory=list)

    def add(
        self,
        corners: Float32[np.ndarray, "f 3 3"],
        normals: Float32[np.ndarray, "f 3 3"],
        rows: Int32[np.ndarray, " f"],
        uv: Float32[np.ndarray, "f 3 2"] | None = None,
        rgb_linear: Float32[np.ndarray, "f 3 3"] | None = None,
        alpha: Float32[np.ndarray, "f 3"] | None = None,
    ) -> None:
        self.corners.append(corners)
        self.normals.append(normals)
        self.rows.append(rows)
        # the kernels need numbers: NaN marks corners without coordinates
        self.uv.append(np.zeros((len(corners), 3, 2), np.float32) if uv is None else np.nan_to_num(uv))
        self.rgb_linear.append(rgb_linear)
        self.alpha.append(alpha)

    def surfaces(self) -> SurfaceArrays:
        colored = any(rgb is not None for rgb in self.rgb_linear)
        colors = [
            np.ones_like(corners) if rgb is None else np.nan_to_num(rgb, nan=1.0)
            for corners, rgb in zip(self.corners, self.rgb_linear, strict=True)
            if colored
        ]
        is_clear = any(alpha is not None for alpha in self.alpha)
        alphas = [
            np.ones(corners.shape[:2], np.float32) if alpha is None else alpha
            for corners, alpha in zip(self.corners, self.alpha, strict=True)
            if is_clear
        ]
        nothing = np.zeros((0, 3, 3), np.float32)
        return SurfaceArrays(
            np.concatenate([nothing, *self.corners]),
            np.concatenate([nothing, *self.normals]),
            np.concatenate([np.zeros((0, 3, 2), np.float32), *self.uv]),
            np.concatenate([np.zeros(0, np.int32), *self.rows]),
            np.concatenate([nothing, *colors]),
            np.concatenate([np.zeros((0, 3), np.float32), *alphas]),
        )


def _add_mesh(
    builder: _MeshBuilder,
    mesh: StageMesh,
    number: int,
    shape: MeshShape,
    up: Float64[np.ndarray, "3"],
    warn: WarnCallback,
) -> None:
    name = f"meshes[{number}]"
    for note in shape.notes:
        warn(f"{mesh.file}: {note}")
    materials = _face_materials(mesh, name, shape, warn)
    for chosen, given in materials:
        # only the winding tells which side of glass is inside
        if isinstance(given.material, Glass) and (turned := turn_outwards(shape, chosen)) is not None:
            said = (
                "faces inwards, or parts of it do; what does is turned inside out, as glass needs an outside."
            )
            warn(f"{name}: {mesh.file} {said}")
            shape = turned
    turn = up_axis_rotation(mesh_up_axis(mesh), mesh.turn_degrees, up)
    corners = transform_points(shape.vertices, mesh, turn)[shape.faces].astype(np.float32)
    degrees = SMOOTH_DEGREES if mesh.smooth_degrees is None else mesh.smooth_degrees
    normals = corner_normals(corners, degrees)
    if mesh.smooth_degrees is None and shape.corner_normals is not None:
        stated = transform_normals(shape.corner_normals, mesh, turn)
        known = np.isfinite(stated).all(axis=(1, 2))
        normals[known] = stated[known]
    rows = np.empty(len(corners), np.int32)
    alpha = np.ones((len(corners), 3), np.float32)
    for chosen, given in materials:
        has_uv = shape.corner_uv is not None and bool(np.isfinite(shape.corner_uv[chosen]).all())
        # a stage's own material replaces the file's colors as well
        tinted = mesh.material is None and shape.corner_rgb_linear is not None
        if given.uses_vertex_alpha and shape.corner_alpha is not None:
            alpha[chosen] = np.clip(np.nan_to_num(shape.corner_alpha[chosen], nan=1.0), 0.0, 1.0)
        row = builder.table.add(
            given.material,
            f"{name}.material",
            has_uv=has_uv,
            uses_vertex_color=tinted,
            uses_vertex_alpha=given.uses_vertex_alpha,
            images=given.images,
        )
        rows[chosen] = row
        if isinstance(given.material, Emissive) and given.material.emission > 0.0:
            area = triangle_areas(corners[chosen])
            if not area.sum() > 0.0:
                raise ConfigError(f"{name}: shines, but has no area; give it a surface, or no emission.")
            own = np.flatnonzero(chosen)[area > 0.0]  # triangles without area have no density of samples
            texture, opacity = builder.table.set_emissive(row, builder.light_count + len(builder.emissive))
            radiance = given.material.emission * srgb_to_linear(np.array(given.material.emission_srgb))
            uv = np.zeros((len(own), 3, 2), np.float32)
            if shape.corner_uv is not None:
                uv = np.nan_to_num(shape.corner_uv[own])
            builder.emissive.append(EmissiveMesh(corners[own], uv, alpha[own], radiance, texture, opacity))
    is_clear = any(given.uses_vertex_alpha for _, given in materials)
    builder.add(corners, normals, rows, shape.corner_uv, shape.corner_rgb_linear, alpha if is_clear else None)


def _face_materials(
    mesh: StageMesh, name: str, shape: MeshShape, warn: WarnCallback
) -> list[tuple[Bool[np.ndarray, " f"], ImportedMaterial]]:
    """Return the material of each face: the stage's, or else the file's."""
    if mesh.material is not None:
        return [(np.ones(len(shape.faces), bool), ImportedMaterial(mesh.material, {}))]
    numbers = shape.material_numbers
    if numbers is None:
        numbers = np.full(len(shape.faces), -1, np.int32)
    scale = float(np.prod(np.broadcast_to(np.array(mesh.scale), 3))) ** (1 / 3)
    found = []
    for value in np.unique(numbers):
        chosen = numbers == value
        if value < 0:
            # white, as corner colors are factors
            plain = Diffuse(color_srgb=(1, 1, 1)) if shape.corner_rgb_linear is not None else Diffuse()
            found.append((chosen, ImportedMaterial(plain, {})))
            continue

        def is_closed(chosen: Bool[np.ndarray, " f"] = chosen) -> bool:
            return count_open_edges(shape, chosen) == 0

        try:
            given = import_material(
                shape.materials[value], is_closed, scale, lambda text: warn(f"{mesh.file}: {text}")
            )
        except ConfigError as error:
            raise ConfigError(f"{name}: {mesh.file}: {error}") from None
        found.append((chosen, given))
    return found


def check_outside_glass(meshes: CompiledMeshes, origin_world: Float32[np.ndarray, "3"], camera: str) -> None:
    """Check that a camera is not inside a mesh of glass, where refraction would be wrong.

    Raises:
        ConfigError: the camera, which is called ``camera``, stands in glass.
    """
    if not (meshes.materials.kinds == GLASS).any():
        return
    # A direction that meets edges by bad luck only; what the ray crosses is counted surface by surface.
    direction = np.array([[0.5773, 0.5774, 0.5772]], np.float32)
    sides: dict[int, int] = {}
    t = 0.0
    for _ in range(10_000):
        hit = meshes.triangles.closest(RayBatch(origin_world[None], direction, t))
        face = int(hit.faces[0])
        if face < 0:
            break
        t = float(hit.distances[0]) * (1 + 1e-6) + 1e-9  # beyond the hit, by more than its rounding
        row = int(meshes.surfaces.material_ids[face])
        corner = meshes.surfaces.corners_world[face].astype(np.float64)
        normal = np.cross(corner[1] - corner[0], corner[2] - corner[0])
        # leaving counts up, entering down
        sides[row] = sides.get(row, 0) + (1 if float(direction[0] @ normal) > 0 else -1)
    if any(count > 0 and meshes.materials.kinds[row] == GLASS for row, count in sides.items()):
        raise ConfigError(f"{camera}: the camera stands inside a mesh of glass; move one of the two.")


def mesh_up_axis(mesh: StageMesh) -> str:
    """Return the axis of a mesh's own frame that is rotated to the stage's up."""
    if mesh.up_axis is not None:
        return mesh.up_axis
    return "y" if mesh.shape is not None or (mesh.file or "").lower().endswith(".glb") else "world"


def load_mesh_shape(
    mesh: StageMesh, number: int, folder: Path, origin_world: Origin = NO_ORIGIN
) -> MeshShape:
    """Return the triangles of mesh ``number`` before placement, with its file's materials.

    Vertices of a file that has them in large coordinates are about ``origin_world``.

    Raises:
        ConfigError: its file is to be glass and is not closed, or holds no triangles.
        SceneFileError: its file cannot be read.
    """
    if mesh.shape is not None:
        return primitive_shape(mesh.shape)
    return load_file_shape(mesh, number, folder, origin_world)
