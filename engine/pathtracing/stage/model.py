"""The stage's data model: meshes, lights, an environment and Gaussian scenes that are rendered together.

Positions and lengths are in world units, angles in degrees. Colors of materials and lights are display
(sRGB-encoded) values in [0, 1] and turned into linear ones for the transport of light; strengths of lights
are linear. Imports neither torch nor numba.
"""

import math
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from octasplat.engine.pathtracing.stage.base import (
    IS_NUMBER,
    WHITE,
    Color,
    Finite,
    NonNegative,
    Positive,
    StageModel,
    Transformed,
    UnitInterval,
    Vector,
)
from octasplat.engine.pathtracing.stage.materials import Glass, Material
from octasplat.engine.pathtracing.stage.motion import Keys, LightKey, MeshKey, check_keys

MAX_MESHES = 1000
MAX_LIGHTS = 1000
MAX_SCENES = 100


class RestingPlace(StageModel):
    """A place on the Gaussians' surface on which a mesh rests.

    Either a pixel of a photograph or a ray; where it meets the scene (the distance at which half of the
    light is gone), the mesh's lowest point comes to lie, its middle above it.

    Attributes:
        view: name of a photograph of the run.
        pixel: column and row in the photograph at its full size, from its upper left corner.
        origin: of a ray.
        direction: of the ray.
    """

    view: str | None = None
    pixel: tuple[Finite, Finite] | None = None
    origin: Vector | None = None
    direction: Vector | None = None

    @model_validator(mode="after")
    def _check_one_source(self) -> "RestingPlace":
        photograph = (self.view is not None, self.pixel is not None)
        ray = (self.origin is not None, self.direction is not None)
        if {photograph, ray} != {(True, True), (False, False)}:
            raise ValueError("give either view and pixel, or origin and direction")
        if self.direction is not None and not any(self.direction):
            raise ValueError("the direction has no length")
        return self


class StageMesh(Transformed):
    """A mesh from a file, or a primitive shape.

    Attributes:
        file: OBJ, PLY or GLB.
        shape: a ``sphere`` of radius 1, a ``cube`` from -1 to 1, or a ``plane`` from -1 to 1 across the
            stage's up.
        up_axis: which of the file's axes is turned to the stage's up; ``world`` leaves the file as it is.
            By default y for GLB (glTF says so) and world for the others.
        turn_degrees: about the stage's up, anticlockwise seen from above, before ``rotation_degrees``.
        smooth_degrees: edges up to this angle are shaded as if they were round; 0 shows every facet. By
            default the normals of the file are taken, or 30 where it has none.
        material: what it is made of; by default what the file says of its materials and colors, or else a
            matt grey.
        on: a place in the scene on which it stands; its position counts from there.
        keys: where it is in single images of a film.
    """

    file: str | None = None
    shape: Literal["sphere", "cube", "plane"] | None = None
    up_axis: Literal["world", "x", "-x", "y", "-y", "z", "-z"] | None = None
    turn_degrees: Finite = 0.0
    smooth_degrees: Annotated[float, Field(ge=0, le=180), IS_NUMBER] | None = None
    material: Material | None = None
    on: RestingPlace | None = None
    keys: Keys[MeshKey] = ()

    @model_validator(mode="after")
    def _check_one_source(self) -> "StageMesh":
        check_keys(self.keys, ("position", "turn_degrees"))
        if (self.file is None) == (self.shape is None):
            raise ValueError("give either a file or a shape")
        if self.shape == "plane" and isinstance(self.material, Glass):
            raise ValueError("a plane encloses nothing, so that it cannot be glass; take a flat cube")
        return self


class LightModel(StageModel):
    """Settings that all lights have.

    Attributes:
        color_srgb: of the light.
        adds_light: whether it adds its light to shadowed Gaussians. Otherwise their colors hold it already,
            and they only lose it where something new is in its way.
        lights_meshes: whether it lights meshes, and Gaussians with materials; it is seen all the same.
        casts_shadows: whether anything keeps it off. Without shadows it takes nothing from Gaussians.
        only_shadows: it is not seen and lights nothing; only its shadows fall on shadowed Gaussians, of which
            the stage needs some.
        keys: where it is in single images of a film.
    """

    color_srgb: Color = WHITE
    adds_light: bool = False
    lights_meshes: bool = True
    casts_shadows: bool = True
    only_shadows: bool = False
    keys: Keys[LightKey] = ()

    @model_validator(mode="after")
    def _check_keys(self) -> "LightModel":
        if self.only_shadows and (self.adds_light or not self.casts_shadows):
            raise ValueError("a light of only_shadows casts shadows and adds no light; leave out the others")
        check_keys(self.keys, tuple(type(self).model_fields))
        return self


class PointLight(LightModel):
    """Light from a point, or from a sphere, in all directions.

    Attributes:
        intensity: linear radiant intensity; at distance d it gives the irradiance intensity / d squared.
        radius: of the ball, whose radiance is the intensity over its disc; 0 is a point, which casts hard
            shadows.
        visible: whether cameras, mirrors and glass see the ball, and other lights its shadow.
    """

    kind: Literal["point"] = "point"
    position: Vector
    intensity: NonNegative
    radius: NonNegative = 0.0
    visible: bool = True


class SpotLight(LightModel):
    """Light from a point into a cone.

    Attributes:
        direction: of the cone's axis.
        outer_degrees: angle from the axis at which the light ends.
        inner_degrees: angle up to which it has its full intensity; between the two it falls off with the
            square of a linear function of the cosine, as in glTF's KHR_lights_punctual.
    """

    kind: Literal["spot"] = "spot"
    position: Vector
    direction: Vector
    intensity: NonNegative
    outer_degrees: Annotated[float, Field(gt=0, lt=90), IS_NUMBER] = 30.0
    inner_degrees: Annotated[float, Field(ge=0, lt=90), IS_NUMBER] = 20.0

    @model_validator(mode="after")
    def _check_cone(self) -> "SpotLight":
        if not any(self.direction):
            raise ValueError("the direction has no length")
        if self.inner_degrees >= self.outer_degrees:
            raise ValueError("inner_degrees must be less than outer_degrees")
        return self


class DirectionalLight(LightModel):
    """Parallel light from infinitely far away.

    Attributes:
        direction: the way that the light goes.
        irradiance: linear, on a surface that faces the light.
    """

    kind: Literal["directional"] = "directional"
    direction: Vector
    irradiance: NonNegative

    @model_validator(mode="after")
    def _check_direction(self) -> "DirectionalLight":
        if not any(self.direction):
            raise ValueError("the direction has no length")
        return self


class RectangleLight(LightModel):
    """A rectangular emitter; its back is black.

    Attributes:
        position: its centre.
        direction: the way that it faces.
        width: along the side that is level with the stage's up.
        height: along the other side.
        radiance: linear, the same in all directions in front.
        visible: whether cameras, mirrors and glass see the rectangle, and other lights its shadow.
    """

    kind: Literal["rectangle"] = "rectangle"
    position: Vector
    direction: Vector
    width: Positive
    height: Positive
    radiance: NonNegative
    visible: bool = True

    @model_validator(mode="after")
    def _check_direction(self) -> "RectangleLight":
        if not any(self.direction):
            raise ValueError("the direction has no length")
        return self


Light = Annotated[PointLight | SpotLight | DirectionalLight | RectangleLight, Field(discriminator="kind")]


class Environment(StageModel):
    """Distant light from all directions.

    Attributes:
        file: equirectangular HDR or EXR image of linear radiance.
        up: the direction in the world that is at its top; by default the stage's up.
        rotation_degrees: turns the image about its up.
        strength: factor.
        visible: whether the camera sees it; otherwise it only lights, and shows in mirrors and glass.
    """

    file: str
    # not written where it is not given, as former versions, of services and of workers, do not know it
    up: Vector | None = Field(None, exclude_if=lambda up: up is None)
    rotation_degrees: Finite = 0.0
    strength: NonNegative = 1.0
    visible: bool = True

    @model_validator(mode="after")
    def _check_up(self) -> "Environment":
        if self.up is not None and not math.hypot(*self.up) > 1e-6:
            raise ValueError("up has no length")
        return self


class StageGaussians(Transformed):
    """A scene of Gaussians and how it interacts with light.

    Attributes:
        file: splat file of any format; None for the scene that is rendered. Its scale is one number.
        light: ``emissive`` shows the trained colors as they are; ``shadowed`` takes from them what the
            meshes keep off of the stage's lights, and adds the light of those that add theirs, and of meshes
            that shine; ``relit`` takes them as the albedo of a matt surface with
            the octagons' normals that the stage's lights shine on, or shows the materials of a scene that has
            some. None is ``relit`` for the scene of a run whose materials can be lit, by the stage's
            environment or by the light that the run has learnt, and else ``shadowed``.
        ambient: share of the trained color that is there without the stage's lights (shadowed, relit).
        shadows_on_meshes: whether they keep light off the meshes.
        shadows_on_gaussians: whether they keep light off the Gaussians. Trained colors hold the scene's
            own shadows already.
        shadow_bias: Gaussians nearer than this to a lit point cast no shadow on it, world units; None takes
            3 % of the scene's size, or 1.5 standard deviations of its Gaussians where that is more.
    """

    file: str | None = None
    # not written where it is not given: former versions, of services and of workers, take no null
    light: Literal["emissive", "shadowed", "relit"] | None = Field(
        None, exclude_if=lambda light: light is None
    )
    ambient: UnitInterval = 0.4
    shadows_on_meshes: bool = True
    shadows_on_gaussians: bool = False
    shadow_bias: NonNegative | None = None

    @model_validator(mode="after")
    def _check_one_scale(self) -> "StageGaussians":
        if isinstance(self.scale, tuple):
            raise ValueError("Gaussians have one scale; give one number")
        return self


class Integrator(StageModel):
    """Settings of the path tracer.

    Attributes:
        samples: paths a pixel.
        max_depth: most surfaces that a path meets.
        roulette_depth: from this surface on paths may end by chance (russian roulette).
        seed: of the random numbers.
        anti_aliasing: paths begin all over the pixel rather than at its centre.
        clamp: most linear radiance that one path brings by way of a matt or rough surface; None for no
            limit. A limit makes the picture a little darker and takes away bright specks.
        exposure: factor of the linear picture, in stops (2 to the power of it).
        tone: curve from linear values to what is shown: ``none`` clips at 1.
        aperture: diameter of the lens in world units; 0 shows everything sharp.
        focus_distance: along the camera's axis, world units; what is there is sharp.
        layers: pictures are EXR files with what a compositor needs: the scene, the shadows and the things.
        denoise: noise is taken from what light brings, guided by colors and normals; the Gaussians' own
            colors stay as they are. Needs the extra ``denoise``.
    """

    samples: Annotated[int, Field(ge=1, le=65536), IS_NUMBER] = 16
    max_depth: Annotated[int, Field(ge=1, le=64), IS_NUMBER] = 8
    roulette_depth: Annotated[int, Field(ge=1, le=64), IS_NUMBER] = 4
    seed: Annotated[int, Field(ge=0, lt=1 << 31), IS_NUMBER] = 0
    anti_aliasing: bool = True
    clamp: Positive | None = None
    exposure: Annotated[float, Field(ge=-20, le=20), IS_NUMBER] = 0.0
    tone: Literal["none", "reinhard", "filmic"] = "none"
    aperture: NonNegative = 0.0
    focus_distance: Positive | None = None
    layers: bool = False
    denoise: bool = False

    @model_validator(mode="after")
    def _check_focus(self) -> "Integrator":
        if self.aperture > 0 and self.focus_distance is None:
            raise ValueError("an aperture needs a focus_distance")
        return self


class Stage(StageModel):
    """Everything that is rendered together.

    Attributes:
        version: of the format.
        up: the direction that is up in the world.
        gaussians: Gaussian scenes; by default the one that is rendered.
        meshes: things put among them.
        lights: new lights.
        environment: light from all around.
        integrator: how the picture is computed.
    """

    version: Annotated[Literal[1], IS_NUMBER] = 1
    up: Vector = (0.0, -1.0, 0.0)
    gaussians: Annotated[tuple[StageGaussians, ...], Field(max_length=MAX_SCENES)] = (StageGaussians(),)
    meshes: Annotated[tuple[StageMesh, ...], Field(max_length=MAX_MESHES)] = ()
    lights: Annotated[tuple[Light, ...], Field(max_length=MAX_LIGHTS)] = ()
    environment: Environment | None = None
    integrator: Integrator = Integrator()

    @field_validator("lights")
    @classmethod
    def _check_shadows_fall(cls, lights: tuple[Light, ...], info: Any) -> tuple[Light, ...]:
        # unknown where they are refused themselves
        gaussians = info.data.get("gaussians")
        if gaussians is None or any(scene.light in (None, "shadowed") for scene in gaussians):
            return lights
        for number, light in enumerate(lights):
            if light.only_shadows:
                raise ValueError(
                    f"the shadows of lights[{number}] (only_shadows) fall on Gaussians with light = "
                    '"shadowed" alone, and this stage has none; give [[gaussians]] this light, or leave the '
                    "lamp out"
                )
        return lights

    @model_validator(mode="after")
    def _check_up(self) -> "Stage":
        if not math.hypot(*self.up) > 1e-6:
            raise ValueError("up has no length")
        return self
