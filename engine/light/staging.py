"""From a stage to the arrays that paths are traced through."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int64

from engine.colour import srgb_to_linear
from engine.errors import ConfigError, DatasetError
from engine.light.arrays import Materials, MeshQueries, Surfaces
from engine.light.bsdf import albedo_table
from engine.light.environment import EnvironmentMap, environment_frame, read_environment
from engine.light.kernels_bsdf import BURLEY, COUPLED
from engine.light.kernels_surface import DIFFUSE, GLASS, LIGHT, MIRROR, OPAQUE
from engine.light.lights import LightArrays, light_arrays, rectangle_sides
from engine.light.meshes import Shape, corner_normals, open_edges, placed, read_shape, simple_shape, turn_to
from engine.light.stage import (
    Dielectric,
    Diffuse,
    Glass,
    Material,
    Metal,
    MetallicRoughness,
    Mirror,
    RectangleLight,
    Stage,
    StageMesh,
)
from engine.rays import RayBatch
from engine.render.images import read_image
from engine.trace.meshes import TriangleScene

MAX_TEXELS = 1 << 27


@dataclass(frozen=True)
class LitMeshes:
    """The meshes, lights and surroundings of a stage, ready to be traced.

    Attributes:
        surfaces: all triangles, those of visible rectangle lights included.
        triangles: what rays are sent through.
        obstacles: the same without glass; None where there is no glass.
        glass: glass alone, its faces in the order of ``glass_faces``.
        glass_faces: rows in the surfaces.
        materials: of the triangles.
        lights: of the stage; the environment is the last of them.
        environment_visible: whether the camera sees the environment.
    """

    surfaces: Surfaces
    triangles: TriangleScene
    materials: Materials
    lights: LightArrays
    environment_visible: bool
    obstacles: TriangleScene | None = None
    glass: TriangleScene | None = None
    glass_faces: Int64[np.ndarray, " g"] | None = None

    @property
    def queries(self) -> MeshQueries:
        """What kernels ask Embree; good while this lives."""
        if self.obstacles is None or self.glass is None or self.glass_faces is None:
            every = self.triangles.any_query
            no_glass = self.triangles.closest_query._replace(scene=0)
            return MeshQueries(self.triangles.closest_query, every, every, no_glass, np.empty(0, np.int64))
        return MeshQueries(
            self.triangles.closest_query, self.triangles.any_query, self.obstacles.any_query,
            self.glass.closest_query, self.glass_faces,
        )  # fmt: skip

    def lit_by(self, lights: LightArrays) -> "LitMeshes":
        """The same meshes in other light, their environment unseen by the camera."""
        return replace(self, lights=lights, environment_visible=False)


def stage_meshes(stage: Stage, folder: Path, *, threads: int = 0) -> LitMeshes:
    """Read and place everything of a stage but its Gaussians.

    Args:
        stage: whose meshes have no place in the scene left to be found (``on``).
        folder: where the stage's files are relative to.
        threads: for building and tracing; 0 takes all.

    Raises:
        ConfigError: a mesh of glass is not closed, or an image is none.
        SceneFileError: a mesh cannot be read.
    """
    up = np.array(stage.up)
    table = _MaterialTable(folder)
    corners, normals, uvs, rows = [], [], [], []
    for number, mesh in enumerate(stage.meshes):
        shape = stage_shape(mesh, number, folder)
        points = placed(shape.vertices @ turn_to(up_axis(mesh), up).T, mesh)
        at = points[shape.faces].astype(np.float32)
        corners.append(at)
        normals.append(corner_normals(at, mesh.smooth_degrees))
        uvs.append(shape.corner_uv if shape.corner_uv is not None else np.zeros((len(at), 3, 2), np.float32))
        material = mesh.material or Diffuse()
        rows.append(np.full(len(at), table.add(material, shape.corner_uv is not None, number), np.int32))
    for number, light in enumerate(stage.lights):
        if isinstance(light, RectangleLight) and light.visible:
            corners.append(_rectangle(light, up))
            normals.append(corner_normals(corners[-1], 0.0))
            uvs.append(np.zeros((2, 3, 2), np.float32))
            rows.append(np.full(2, table.add_light(number), np.int32))
    environment = None
    if stage.environment is not None:
        radiance = read_environment(folder / stage.environment.file)
        environment = EnvironmentMap(
            radiance * np.float32(stage.environment.strength),
            environment_frame(up, stage.environment.rotation_degrees),
        )
    surfaces = Surfaces(
        np.concatenate([np.zeros((0, 3, 3), np.float32), *corners]),
        np.concatenate([np.zeros((0, 3, 3), np.float32), *normals]),
        np.concatenate([np.zeros((0, 3, 2), np.float32), *uvs]),
        np.concatenate([np.zeros(0, np.int32), *rows]),
    )
    points = surfaces.corners_world.reshape(-1, 3)
    faces = np.arange(len(points), dtype=np.int32).reshape(-1, 3)
    materials = table.arrays()
    is_glass = materials.kinds[surfaces.materials] == GLASS
    some = bool(is_glass.any())
    return LitMeshes(
        surfaces,
        TriangleScene(points, faces, threads=threads),
        materials,
        light_arrays(stage.lights, up, environment),
        stage.environment is not None and stage.environment.visible,
        TriangleScene(points, faces[~is_glass], threads=threads) if some else None,
        TriangleScene(points, faces[is_glass], threads=threads) if some else None,
        np.flatnonzero(is_glass) if some else None,
    )


def refuse_inside_glass(meshes: LitMeshes, origin_world: Float32[np.ndarray, "3"], camera: str) -> None:
    """Refuse a camera within a mesh of glass, from where refraction would go wrong.

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
        t = float(hit.distances[0]) * (1 + 1e-6) + 1e-9
        row = int(meshes.surfaces.materials[face])
        corner = meshes.surfaces.corners_world[face].astype(np.float64)
        normal = np.cross(corner[1] - corner[0], corner[2] - corner[0])
        sides[row] = sides.get(row, 0) + (1 if float(direction[0] @ normal) > 0 else -1)
    if any(count > 0 and meshes.materials.kinds[row] == GLASS for row, count in sides.items()):
        raise ConfigError(f"{camera}: the camera stands inside a mesh of glass; move one of the two.")


def up_axis(mesh: StageMesh) -> str:
    """The axis of a mesh's own frame that is turned to the stage's up."""
    if mesh.up_axis is not None:
        return mesh.up_axis
    return "y" if mesh.shape is not None or (mesh.file or "").lower().endswith(".glb") else "world"


def stage_shape(mesh: StageMesh, number: int, folder: Path) -> Shape:
    """The triangles of mesh ``number`` before it is placed.

    Raises:
        ConfigError: it is of glass and not closed.
        SceneFileError: its file cannot be read.
    """
    if mesh.shape is not None:
        shape, name = simple_shape(mesh.shape), str(mesh.shape)
    else:
        assert mesh.file is not None
        shape, name = read_shape(folder / mesh.file), str(folder / mesh.file)
    if isinstance(mesh.material, Glass):
        count = open_edges(shape)
        if count:
            raise ConfigError(
                f"meshes[{number}]: {name} is not closed ({count:,} edges without two faces that wind "
                "alike), so that it cannot be glass; close it or choose another material."
            )
    return shape


def _rectangle(light: RectangleLight, up_world: Float64[np.ndarray, "3"]) -> Float32[np.ndarray, "2 3 3"]:
    u, v = rectangle_sides(light, up_world)
    centre = np.array(light.position)
    corners = [centre - u / 2 - v / 2, centre + u / 2 - v / 2, centre + u / 2 + v / 2, centre - u / 2 + v / 2]
    return np.array([[corners[0], corners[1], corners[2]], [corners[0], corners[2], corners[3]]], np.float32)


_DEFAULTS: dict[str, np.ndarray] = {
    "kinds": np.array(DIFFUSE, np.int32),
    "colours_linear": np.ones(3),
    "metallic": np.array(0.0),
    "roughness": np.array(0.0),
    "iors": np.array(1.5),
    "absorption": np.zeros(3),
    "grounds": np.array(COUPLED, np.int32),
    "kept": np.array(1, np.int32),
    "coats": np.array(0, np.int32),
    "colour_textures": np.array(-1, np.int32),
    "metallic_roughness_textures": np.array(-1, np.int32),
    "lights": np.array(-1, np.int32),
}
"""What a material is where it says nothing else."""


class _MaterialTable:
    """Rows of materials as they come, with their tables and textures."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._rows: list[dict[str, object]] = []
        self._iors: list[float] = [1.5]
        self._textures: dict[tuple[str, bool], int] = {}
        self._images: list[Float32[np.ndarray, "h w 3"]] = []

    def add(self, material: Material, has_uv: bool, number: int) -> int:
        """The row of a material of mesh ``number``."""
        row: dict[str, object] = {}
        if isinstance(material, Glass):
            colour = material.tint_srgb
            row |= {"kinds": GLASS, "iors": material.ior, "absorption": material.absorption}
        else:
            colour = material.colour_srgb
            row["kinds"] = {Diffuse: DIFFUSE, Mirror: MIRROR}.get(type(material), OPAQUE)
        row["colours_linear"] = srgb_to_linear(np.array(colour))
        if isinstance(material, Metal | Dielectric | MetallicRoughness):
            row["roughness"] = material.roughness
        if isinstance(material, Metal):
            row |= {"metallic": 1.0, "kept": material.multiple_scattering}
        if isinstance(material, MetallicRoughness):
            row |= {"metallic": material.metallic, "kept": material.multiple_scattering}
            row["grounds"] = BURLEY if material.diffuse == "burley" else COUPLED
            if material.metallic_roughness_texture is not None:
                row["metallic_roughness_textures"] = self._texture(
                    material.metallic_roughness_texture, False, has_uv, number
                )
        if isinstance(material, Dielectric | MetallicRoughness):
            row |= {"iors": material.ior, "coats": self._coat(material.ior)}
        if isinstance(material, Diffuse | Dielectric | MetallicRoughness) and material.texture is not None:
            row["colour_textures"] = self._texture(material.texture, True, has_uv, number)
        self._rows.append(row)
        return len(self._rows) - 1

    def add_light(self, number: int) -> int:
        """The row of the surface of a light."""
        self._rows.append({"kinds": LIGHT, "lights": number})
        return len(self._rows) - 1

    def arrays(self) -> Materials:
        """All rows as arrays."""
        count = len(self._rows)
        columns = {
            name: np.array([row.get(name, default) for row in self._rows], default.dtype).reshape(
                count, *default.shape
            )
            for name, default in _DEFAULTS.items()
        }
        tables = [albedo_table(ior) for ior in self._iors]
        sizes = np.zeros((len(self._images), 3), np.int64)
        first = 0
        for k, image in enumerate(self._images):
            sizes[k] = first, image.shape[0], image.shape[1]
            first += image.shape[0] * image.shape[1]
        texels = np.concatenate([np.zeros((0, 3), np.float32), *(i.reshape(-1, 3) for i in self._images)])
        return Materials(
            **columns,
            mirror=albedo_table(None).by_cosine,
            coat=np.stack([table.by_cosine for table in tables]),
            coat_means=np.stack([table.mean for table in tables]),
            texels_linear=texels,
            texture_sizes=sizes,
        )

    def _coat(self, ior: float) -> int:
        if ior not in self._iors:
            self._iors.append(ior)
        return self._iors.index(ior)

    def _texture(self, name: str, display: bool, has_uv: bool, number: int) -> int:
        """The number of a texture; ``display`` values are made linear, unless the image holds linear ones."""
        path = self._folder / name
        if not has_uv:
            raise ConfigError(
                f"meshes[{number}].material: {path} needs texture coordinates, which the mesh lacks; of an "
                "OBJ with seams, whose vertices have several each, none are read: save it as GLB."
            )
        key = (name, display)
        if key not in self._textures:
            try:
                image = read_image(path)
            except DatasetError as error:
                raise ConfigError(f"meshes[{number}].material: {error}") from None
            rgb = image[..., :3] if image.shape[2] >= 3 else np.repeat(image[..., :1], 3, axis=2)
            if display and path.suffix.lower() not in (".exr", ".hdr"):
                rgb = srgb_to_linear(rgb)
            self._textures[key] = len(self._images)
            self._images.append(np.ascontiguousarray(np.clip(rgb, 0.0, 1.0)))
            if sum(i.shape[0] * i.shape[1] for i in self._images) > MAX_TEXELS:
                raise ConfigError(
                    f"{path}: the textures have more than {MAX_TEXELS >> 20} million pixels together."
                )
        return self._textures[key]
