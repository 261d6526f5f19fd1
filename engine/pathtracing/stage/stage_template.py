"""The first stage file of a scene, with comments. Imports neither torch nor numba."""

import json
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import Literal

from octasplat.engine.core.writing import write_text

BALL_RADIUS_FRACTION = 0.12
"""Radius of the first stage's ball."""
FILE_HAS_NO_LIGHT = "a file does not hold the light that its materials were learnt in."
_HOW = 'For materials write light = "relit" under [[gaussians]] and name a map of light under [environment].'


def shown_as_harmonics(reason: str) -> str:
    """Return that a scene with materials is shown without them, why, and how to show them.

    Args:
        reason: a sentence.
    """
    return f"{reason} So the stage shows its harmonics. {_HOW}"


@dataclass(frozen=True)
class StageLight:
    """How a scene takes light in its first stage.

    Attributes:
        mode: value of ``light`` under ``[[gaussians]]``.
        environment: name of the map that lights it, relative to the stage; None without one.
        environment_up: the direction in the world that is at the map's top.
        note: sentences on the choice, a comment each.
    """

    mode: Literal["shadowed", "relit"] = "shadowed"
    environment: str | None = None
    environment_up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    note: tuple[str, ...] = ()


SHADOWED = StageLight()


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
        note: about the positions, a sentence a line, for the head of the file.
    """

    up: tuple[float, float, float]
    floor: tuple[float, float, float]
    size: float
    light_direction: tuple[float, float, float]
    has_floor: bool = True
    is_beside: bool = False
    note: str = ""


def write_stage_template(path: Path, layout: StageLayout, light: StageLight = SHADOWED) -> None:
    """Write a commented stage for a scene: a ball on the floor, a light, and commented-out examples.

    Args:
        path: the file.
        layout: where things are.
        light: how the scene takes light. In an environment the lamp is a comment.

    Raises:
        OSError: the file cannot be written.
    """
    radius = BALL_RADIUS_FRACTION * layout.size
    centre = tuple(p + radius * u for p, u in zip(layout.floor, layout.up, strict=True))
    lamp = tuple(p - 2.0 * layout.size * d for p, d in zip(layout.floor, layout.light_direction, strict=True))
    is_lit = light.environment is not None
    # with all digits: which way a map lies changes at once where z is about up
    environment_up = str([float(x) for x in light.environment_up]) if is_lit else _format_vector(layout.up)
    name = json.dumps(light.environment or "studio.hdr", ensure_ascii=False)  # TOML quotes as JSON does
    write_text(
        path,
        _TEMPLATE.format(
            places="".join(f"# {line}\n" for line in layout.note.splitlines()),
            up=_format_vector(layout.up),
            scene=(_RELIT if light.mode == "relit" else _SHADOWED).format(
                notes="".join(
                    f"{fill(line, 110, initial_indent='# ', subsequent_indent='# ')}\n" for line in light.note
                )
            ),
            centre=_format_vector(centre),
            floor=_format_vector(layout.floor),
            where=BALL_BESIDE if layout.is_beside else BALL_ON_FLOOR if layout.has_floor else BALL_HANGING,
            # around a thing that stands alone there is nothing for glass to show
            material=_LACQUER if layout.is_beside else _GLASS,
            other_material=_GLASS if layout.is_beside else _LACQUER,
            sun=_commented(_SUN, is_lit).format(
                about=_NEW_SUN if is_lit else _PHOTOGRAPHED_SUN, light=_format_vector(layout.light_direction)
            ),
            light=_format_vector(layout.light_direction),
            lamp=_format_vector(lamp),
            radius=f"{radius:.4g}",
            half=f"{layout.size:.4g}",
            intensity=f"{4.0 * layout.size**2:.4g}",
            environment=_LEARNT_LIGHT * is_lit
            + _commented(_ENVIRONMENT, not is_lit).format(
                name=name, up=environment_up, about_up=_UP_OF_LEARNT if is_lit else _UP_OF_ANY
            ),
        ),
    )


def _commented(text: str, is_comment: bool) -> str:
    """Return keys of a part, each behind a # or not; what is a comment anyway stays one."""
    lines = text.splitlines()
    return "\n".join(f"# {line}" if is_comment and not line.startswith("#") else line for line in lines)


_GLASS = '{ kind = "glass", ior = 1.5 }'
_LACQUER = '{ kind = "dielectric", color_srgb = [0.7, 0.1, 0.1], roughness = 0.2 }'
BALL_ON_FLOOR = "A ball on what seems to be the floor, at"
BALL_BESIDE = "The scene is a thing that stands alone: a ball beside it, on a level with its foot, at"
BALL_HANGING = "No floor is to be seen: a ball that hangs before what the cameras look at, above"


_SHADOWED = """\
{notes}# How the scene takes light. emissive: as trained; shadowed: darker where a new thing keeps light off;
# relit: its colors lit by nothing but the lights below and the ambient share.
[[gaussians]]
light = "shadowed"
ambient = 0.4                    # what is left of the color in full shadow, 0 to 1
shadows_on_meshes = true
# shadows_on_gaussians = false   # the scene's own shadows are in its colors already
# Left out, shadow_bias is 3 % of the scene's size, or 1.5 standard deviations of its Gaussians where that is
# more: Gaussians that are nearer than this to a lit one cast no shadow on it."""
_RELIT = """\
{notes}# How the scene takes light. relit: the surface that its materials describe, in this stage's light.
# emissive and shadowed show its harmonics, which are faster and have no sharp reflections.
[[gaussians]]
light = "relit"
shadows_on_meshes = true
# shadows_on_gaussians = false   # no matter to materials, which shadow and mirror each other anyway
# ambient = 0.4                  # of shadowed colors; no matter to materials
# Left out, shadow_bias, how far above the surface rays begin, is half a standard deviation of the Gaussians
# there."""
_PHOTOGRAPHED_SUN = "The light, from where it seems to come in the photographs."
_NEW_SUN = "A new lamp, beside the light from all around: from where that seems to come."
_SUN = """\
# {about}
[[lights]]
kind = "directional"
direction = {light}              # the way that the light goes
irradiance = 2.0                 # on what faces it; of 3.14 a matt white thing is as white as is shown"""
_LEARNT_LIGHT = "# The light from all around that was learnt with the materials.\n"
_UP_OF_LEARNT = "at its top: materials.up_world of the run"
_UP_OF_ANY = "at its top; of background.exr of a run [0, -1, 0], of environment.exr its materials.up_world"
_ENVIRONMENT = """\
[environment]
file = {name}
up = {up}   # {about_up}
# rotation_degrees = 0.0         # about up, anticlockwise seen from above
# strength = 1.0
visible = false                  # the camera sees the scene's own background; left out: true"""


def _format_vector(values: tuple[float, ...]) -> str:
    return "[" + ", ".join(f"{value:.4g}" for value in values) + "]"


_TEMPLATE = """\
# A stage: things, lights and how the scene takes part. Lengths are in the scene's units, angles in degrees,
# colors display values from 0 to 1, strengths of lights linear, files relative to this one. A key that stands
# behind a # in a part that is in use has that value without it. Everything that can be set: docs/light.md.
{places}version = 1
up = {up}

{scene}

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

{sun}
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

{environment}

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
