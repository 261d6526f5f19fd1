"""Stage files: TOML read and validated, and a commented template written. Imports neither torch nor numba."""

import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.writing import write_text
from octasplat.engine.pathtracing.stage.materials import Glass
from octasplat.engine.pathtracing.stage.model import Stage, StageMesh
from octasplat.engine.pathtracing.stage.sidecar_files import sidecar_files
from octasplat.engine.pathtracing.stage.stage_errors import stage_error

MAX_STAGE_BYTES = 16 << 20
TEXTURE_KEYS = (
    "texture", "metallic_roughness_texture", "normal_texture", "emission_texture", "opacity_texture",
    "clear_coat_texture", "clear_coat_roughness_texture",
)  # fmt: skip
"""Keys of materials that name images."""


def read_stage(path: Path) -> Stage:
    """Return the stage of a TOML file, its files' names made relative to the file's folder.

    Raises:
        ConfigError: no such file, no TOML, an unknown key, a value out of range, or a file that it names
            and that is not there.
    """
    try:
        if path.stat().st_size > MAX_STAGE_BYTES:
            raise ConfigError(f"{path}: is larger than {MAX_STAGE_BYTES >> 20} MB, which no stage needs.")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: the stage cannot be read ({error}).") from None
    stage = parse_stage(text, str(path))
    for key, name in referenced_files(stage):
        if not (path.parent / name).is_file():
            raise ConfigError(f"{path}: {key}: there is no file {path.parent / name}.")
    return stage


def parse_stage(text: str, name: str) -> Stage:
    """Return the stage of a TOML text; ``name`` is what errors call it.

    Raises:
        ConfigError: no TOML, an unknown key, or a value out of range.
    """
    try:
        return Stage.model_validate(tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{name}: is no TOML: {toml_complaint(text, error)}.") from None
    except ValidationError as error:
        raise ConfigError(f"{name}: {stage_error(error.errors()[0])[1]}") from None


def toml_complaint(text: str, error: Exception) -> str:
    """Return what is wrong with a TOML text, with the rule that numbers begin with a digit where it helps."""
    lines, place = text.splitlines(), re.search(r"line (\d+)", str(error))
    line = lines[int(place[1]) - 1] if place is not None and int(place[1]) <= len(lines) else ""
    if number := re.search(r"(?<![\w.])[-+]?\.\d+", line):
        return f"{error}; write {number[0].replace('.', '0.')} for {number[0]}"
    return str(error)


def referenced_files(stage: Stage) -> Iterator[tuple[str, str]]:
    """Return the key and the name of every file that a stage names."""
    if stage.environment is not None:
        yield "environment.file", stage.environment.file
    for number, scene in enumerate(stage.gaussians):
        if scene.file is not None:
            yield f"gaussians[{number}].file", scene.file
    for number, mesh in enumerate(stage.meshes):
        if mesh.file is not None:
            yield f"meshes[{number}].file", mesh.file
        for key in TEXTURE_KEYS:
            texture = getattr(mesh.material, key, None)
            if texture is not None:
                yield f"meshes[{number}].material.{key}", texture


def glass_meshes(stage: Stage) -> dict[int, StageMesh]:
    """Return the meshes of files that are to be glass, and so must be closed, by their numbers."""
    return {
        number: mesh
        for number, mesh in enumerate(stage.meshes)
        if mesh.file is not None and isinstance(mesh.material, Glass)
    }


def stage_identity(stage: Stage, folder: Path) -> tuple[object, ...]:
    """Return what of a stage decides how an image looks: the stage, and the files that it names.

    Args:
        stage: the stage.
        folder: where the names of its files are relative to.
    """
    files = [folder / name for _, name in referenced_files(stage)]
    return stage, files, [path.parent / name for path in files for name in sidecar_files(path)]


def with_renamed_files(stage: Stage, names: Mapping[str, str]) -> Stage:
    """Return the stage with its files under other names, keyed by their present ones."""
    content = stage.model_dump(mode="json")
    for key, name in referenced_files(stage):
        *path, last = key.replace("[", ".").replace("]", "").split(".")
        place: Any = content
        for part in path:
            place = place[int(part) if part.isdigit() else part]
        place[last] = names.get(name, name)
    return Stage.model_validate(content)


BALL_RADIUS_FRACTION = 0.12
"""Radius of the first stage's ball."""


@dataclass(frozen=True)
class StageLayout:
    """Positions and sizes to which a first stage of a scene is fitted.

    Attributes:
        up: the direction that is up, a unit vector.
        floor: a point on what the scene stands on, or on which a ball would stand that hangs free.
        size: about as large as what the cameras look at, world units.
        light_direction: the way that the scene's light seems to go.
        has_floor: whether the scene shows anything level to stand on.
        is_beside: whether the scene is a thing that stands alone, beside whose foot the floor is.
        note: a sentence about the positions, for the head of the file.
    """

    up: tuple[float, float, float]
    floor: tuple[float, float, float]
    size: float
    light_direction: tuple[float, float, float]
    has_floor: bool = True
    is_beside: bool = False
    note: str = ""


def write_stage_template(path: Path, layout: StageLayout) -> None:
    """Write a commented stage for a scene: a ball on the floor, a light, and commented-out examples.

    Raises:
        OSError: the file cannot be written.
    """
    radius = BALL_RADIUS_FRACTION * layout.size
    centre = tuple(p + radius * u for p, u in zip(layout.floor, layout.up, strict=True))
    lamp = tuple(p - 2.0 * layout.size * d for p, d in zip(layout.floor, layout.light_direction, strict=True))
    write_text(
        path,
        _TEMPLATE.format(
            places=f"# {layout.note}\n" if layout.note else "",
            up=_format_vector(layout.up),
            centre=_format_vector(centre),
            floor=_format_vector(layout.floor),
            where=BALL_BESIDE if layout.is_beside else BALL_ON_FLOOR if layout.has_floor else BALL_HANGING,
            # Around a thing that stands alone there is nothing for glass to show.
            material=_LACQUER if layout.is_beside else _GLASS,
            other_material=_GLASS if layout.is_beside else _LACQUER,
            light=_format_vector(layout.light_direction),
            lamp=_format_vector(lamp),
            radius=f"{radius:.4g}",
            half=f"{layout.size:.4g}",
            intensity=f"{4.0 * layout.size**2:.4g}",
        ),
    )


_GLASS = '{ kind = "glass", ior = 1.5 }'
_LACQUER = '{ kind = "dielectric", color_srgb = [0.7, 0.1, 0.1], roughness = 0.2 }'
BALL_ON_FLOOR = "A ball on what seems to be the floor, at"
BALL_BESIDE = "The scene is a thing that stands alone: a ball beside it, on a level with its foot, at"
BALL_HANGING = "No floor is to be seen: a ball that hangs before what the cameras look at, above"


def _format_vector(values: tuple[float, ...]) -> str:
    return "[" + ", ".join(f"{value:.4g}" for value in values) + "]"


_TEMPLATE = """\
# A stage: things, lights and how the scene takes part. Lengths are in the scene's units, angles in degrees,
# colors display values from 0 to 1, strengths of lights linear, files relative to this one. A key that stands
# behind a # in a part that is in use has that value without it. Everything that can be set: docs/light.md.
{places}version = 1
up = {up}

# How the scene takes light. emissive: as trained; shadowed: darker where a new thing keeps light off;
# relit: its colors lit by nothing but the lights below and the ambient share.
[[gaussians]]
light = "shadowed"
ambient = 0.4                    # what is left of the color in full shadow, 0 to 1
shadows_on_meshes = true
# shadows_on_gaussians = false   # the scene's own shadows are in its colors already
# Left out, shadow_bias is 3 % of the scene's size, or 1.5 standard deviations of its Gaussians where that is
# more: Gaussians that are nearer than this to a lit one cast no shadow on it.

# {where} {floor}.
[[meshes]]
shape = "sphere"                 # or "cube", "plane"; or: file = "thing.obj"
position = {centre}
scale = {radius}                 # the radius of a sphere, half the side of the others
smooth_degrees = 180             # edges up to this angle are round
# turn_degrees = 0.0             # about up, anticlockwise seen from above
# rotation_degrees = [0, 0, 0]   # about the world's x, then y, then z
material = {material}
# material = {other_material}
# material = {{ kind = "mirror" }}
# material = {{ kind = "metal", color_srgb = [0.95, 0.8, 0.5], roughness = 0.25 }}
# To stand on what a pixel of a photograph shows (its position then counts from there):
# on = {{ view = "0001.jpg", pixel = [200, 300] }}

# A mirror for a floor. A plane faces up; rotation_degrees turns it to a wall.
# [[meshes]]
# shape = "plane"
# position = {floor}
# scale = {half}
# material = {{ kind = "mirror", color_srgb = [0.9, 0.9, 0.9] }}

# The light, from where it seems to come in the photographs.
[[lights]]
kind = "directional"
direction = {light}              # the way that the light goes
irradiance = 2.0                 # on what faces it; of 3.14 a matt white thing is as white as it can be shown
# color_srgb = [1, 1, 1]         # this and what follows hold for every kind of lamp
# adds_light = false             # true: it is new, not yet in the colors of the photographs
# lights_meshes = true
# casts_shadows = true
# only_shadows = false

# A lamp that is a rectangle casts soft shadows.
# [[lights]]
# kind = "rectangle"
# position = {lamp}
# direction = {light}            # the way that it faces
# width = {half}                 # of the side that is level
# height = {half}
# radiance = 8.0                 # 1 is seen as white
# visible = false                # left out: true

# [[lights]]
# kind = "point"
# position = {lamp}
# intensity = {intensity}        # at a distance d it gives the irradiance intensity / d squared
# radius = 0.0                   # larger makes its shadows soft
# adds_light = true              # it is new: not yet in the colors of the photographs

# [[lights]]
# kind = "spot"
# position = {lamp}
# direction = {light}
# intensity = {intensity}
# outer_degrees = 30.0           # from its axis; beyond there is no light
# inner_degrees = 20.0           # up to here it has its full intensity

# [environment]
# file = "studio.hdr"
# up = {up}   # at its top; of background.exr of a run [0, -1, 0], of environment.exr its materials.up_world
# rotation_degrees = 0.0         # about up, anticlockwise seen from above
# strength = 1.0
# visible = false                # the camera sees the scene's own background; left out: true

[integrator]
samples = 16                     # a pixel; more is smoother and slower
max_depth = 8                    # surfaces that a path of light meets
# roulette_depth = 4             # from this one on paths may end by chance
clamp = 20.0                     # keeps single paths from leaving bright specks; left out: no limit
exposure = 0.0                   # stops
tone = "none"                    # or "reinhard", "filmic"
# anti_aliasing = true
# seed = 0
# aperture = 0.0                 # diameter of the lens; with one, focus_distance says what is sharp
# layers = false
# denoise = false
"""
