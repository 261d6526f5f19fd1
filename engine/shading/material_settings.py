"""All settings of learning materials and light from photographs, with their defaults."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field, field_validator

from octasplat.engine.settings import renamed_settings
from octasplat.engine.settings.base import FormerSetting, Settings
from octasplat.engine.settings.fields import ADVANCED, EXPERIMENTAL, Unit

ENVIRONMENT_EVERY = 4
"""Iterations between two steps of the environment, for each of which all its levels are filtered."""
ENVIRONMENT_RATE = 0.03
"""First size of a step of the environment's log radiance."""
SHADING_RAMP = (0.0, 0.02)
"""Shares of the training when shading begins to replace the harmonics' colors, and when it has."""
PROPAGATION_EVERY = 0.06
"""Share of the training between two times that normals are handed on to neighbours."""
PROPAGATION_UNTIL = 0.4
"""Share of the training at which that ends."""
INITIAL_ALBEDO, INITIAL_METALLIC, INITIAL_ROUGHNESS = 0.5, 0.5, 0.3
"""Materials that all Gaussians begin with: in the middle, and smooth enough to show what they reflect."""
Recipe = Literal["split_sum", "ref_gaussian", "near_field"]


class MaterialSettings(Settings):
    """Settings of learnt materials and environments; shares of the training are of all its iterations."""

    former_names: ClassVar[renamed_settings.FormerNames] = renamed_settings.MATERIALS
    later_settings: ClassVar[frozenset[str]] = frozenset({"fallback", "dark_metal_weight", "residual_share"})

    learn: Annotated[bool, ADVANCED] = Field(
        False,
        description="Learn materials and the light around the scene; nothing else of materials matters if "
        "not. For scenes that reflect; it takes longer and brings settings of its own.",
    )
    recipe: Annotated[Recipe, EXPERIMENTAL] = Field(
        "split_sum",
        description='split_sum is the way of octasplat; ref_gaussian does what the code of "Reflective '
        'Gaussian Splatting" (https://arxiv.org/abs/2412.19282) does: the matt part is a color of its '
        "own from the harmonics, the environment stays in [0, 1], everything is in display "
        "values, visibility is yes or no, and materials start over when deferred shading "
        "begins. near_field is for rooms: only what reflects is shaded, and mirrors the harmonics of what "
        "stands around it.",
    )
    fallback: Annotated[bool | None, ADVANCED] = Field(
        None,
        description="Before a long training by the recipe split_sum, short ones show whether it explains the "
        "photographs. Where new views are more than 1 dB worse than without materials (0.3 dB in photographs "
        "without masks and alpha), and not worse by the recipe near_field, that is used; without masks and "
        "alpha materials are left out otherwise. false keeps split_sum.",
    )
    up_world: Annotated[tuple[float, float, float], Unit("world direction"), ADVANCED] = Field(
        (0.0, 0.0, 1.0),
        description="Direction that is up in the world; it says which way the environment lies. Set it "
        "where the model of the cameras is turned.",
    )
    environment_height: Annotated[int, Unit("texels"), ADVANCED] = Field(
        128,
        ge=16,
        le=512,
        multiple_of=8,
        description="Texels of the environment from up to down; it has twice as many around. Raise it for "
        "mirrors.",
    )
    secondary_from: Annotated[float, Unit("share of iterations"), ADVANCED] = Field(
        0.05, ge=0, le=1, description="Share of the training at which visibility and indirect light begin."
    )
    visibility: Annotated[bool, ADVANCED] = Field(
        True,
        description="Let what stands in the way of a reflection hide the environment there. Turning it off "
        "is faster, for single convex objects.",
    )
    depth_split: Annotated[float, Unit("ray starts"), ADVANCED] = Field(
        2.0,
        ge=0,
        description="Rays whose mean depth is farther from the median than so many times the distance at "
        "which reflected rays begin show two surfaces, which are shaded each by itself; 0 "
        "shades their mean.",
    )
    max_bounces: Annotated[int, Unit("surfaces"), ADVANCED] = Field(
        3,
        ge=1,
        le=8,
        description="Surfaces on the path of a reflected ray. Raise it for mirrors that face each other.",
    )
    reflection_ray_slope: Annotated[tuple[float, float], Unit("tangent"), ADVANCED] = Field(
        (0.1, 0.01),
        description="Tangent of the least angle between a normal and the two facets beside it at which rays "
        "are reflected, at the beginning and from blur_until on; the rougher the surface, the "
        "larger.",
    )
    roughness_probe_fraction: Annotated[float, Unit("share of points"), EXPERIMENTAL] = Field(
        0.0,
        ge=0,
        le=1,
        description="Share of the points that send a third reflected ray while training, by which roughness "
        "learns from how sharply other things are mirrored; 0 leaves that to the environment, "
        "which long trainings are better with.",
    )
    indirect: Annotated[Literal["shaded", "harmonics", "none"], ADVANCED] = Field(
        "shaded",
        description="Light of what stands in the way of a reflection: shaded by the split sum, from the "
        "harmonics, or none. harmonics is faster and less right.",
    )
    ambient_occlusion: Annotated[bool, ADVANCED] = Field(
        True, description="Dim the irradiance where other things hide the environment."
    )
    diffuse_interreflection: Annotated[bool, ADVANCED] = Field(
        True, description="Light matt surfaces by what other surfaces send, too."
    )
    ambient_occlusion_rays: Annotated[int, Unit("rays"), ADVANCED] = Field(
        16,
        ge=4,
        description="Rays from each side of a Gaussian that say how much of the environment is hidden. More "
        "are slower and less noisy.",
    )
    ambient_occlusion_rebuilds: Annotated[int, Unit("rebuilds"), ADVANCED] = Field(
        20,
        ge=1,
        description="Rebuilds of the hierarchy in which all Gaussians have their turn of "
        "ambient_occlusion_rays. Fewer are slower and follow changes sooner.",
    )
    hdr: Annotated[bool, ADVANCED] = Field(
        True, description="Let the environment be brighter than 1, as lamps and the sun are."
    )
    reflected_gradient: Annotated[bool, ADVANCED] = Field(
        True,
        description="Let normals learn through the reflected direction. Turning it off keeps normals to "
        "what depths say.",
    )
    normal_gradient_clip: Annotated[float, Unit("medians"), ADVANCED] = Field(
        2.0,
        ge=0,
        description="Gradients by normals through the reflected direction are cut off at so many times "
        "their median of a batch; 0 leaves them alone.",
    )
    ray_bias: Annotated[float, Unit("extent"), ADVANCED] = Field(
        0.004,
        gt=0,
        description="Distance from the surface at which reflected rays begin, of the extent. Raise it where "
        "surfaces shade themselves in spots.",
    )
    backface_cull_distance: Annotated[float, Unit("extent"), ADVANCED] = Field(
        0.0,
        ge=0,
        description="Distance up to which reflected rays pass what they would meet from behind, of the "
        "extent; for normals that point outwards.",
    )
    blur: Annotated[float, Unit("roughness"), ADVANCED] = Field(
        0.5,
        ge=0,
        le=1,
        description="Roughness of the level of the environment that leads reflected directions at first, "
        "and sees farther than a sharp one; it falls to 0 until blur_until.",
    )
    blur_until: Annotated[float, Unit("share of iterations"), ADVANCED] = Field(
        0.3,
        ge=0,
        le=1,
        description="Share of the training at which blur and reflection_ray_slope have reached "
        "their last values.",
    )
    normal_weight: Annotated[float, Unit("weight"), ADVANCED] = Field(
        0.1, ge=0, description="Weight of the spread of the normals along a ray in the loss."
    )
    depth_normal_weight: Annotated[float, Unit("weight"), ADVANCED] = Field(
        0.1,
        ge=0,
        description="Weight of the angle between normals and the surface that the depths span. Raise it "
        "where surfaces are bumpy.",
    )
    smooth_normal_weight: Annotated[float, Unit("weight"), ADVANCED] = Field(
        0.1,
        ge=0,
        description="Weight of the angle between the normals of neighbouring rays. Raise it for smooth "
        "things, lower it where edges are rounded off.",
    )
    smooth_weight: Annotated[float, Unit("weight"), ADVANCED] = Field(
        0.01,
        ge=0,
        description="Weight of differences of albedo between neighbouring rays. Raise it where reflections "
        "are painted on.",
    )
    smooth_gloss_weight: Annotated[float, Unit("weight"), ADVANCED] = Field(
        0.08,
        ge=0,
        description="Weight of differences of metallic and roughness between neighbouring rays, which "
        "change less over a thing than its color does.",
    )
    smooth_metal: Annotated[float, Unit("factor"), ADVANCED] = Field(
        10.0,
        ge=0,
        description="So many times more smooth_weight counts between metals, which are one color more "
        "often and which have what is reflected wrongly painted on.",
    )
    dark_metal_weight: Annotated[float | None, Unit("weight"), ADVANCED] = Field(
        None,
        ge=0,
        description="Weight of metallic in the loss where the albedo is darker than that of metals. Lower it "
        "where a dark metal is taken for paint; 0 turns it off.",
    )
    prune_unseen: Annotated[bool, ADVANCED] = Field(
        True,
        description="Take away Gaussians that lie in no photograph; reflected rays alone see those, so that "
        "they would become lamps.",
    )
    white_weight: Annotated[float, Unit("weight"), ADVANCED] = Field(
        0.01,
        ge=0,
        description="Weight of the logarithms of the colors of the environment, which keeps it grey where "
        "nothing else is known.",
    )
    environment_smoothness_weight: Annotated[float, Unit("weight"), ADVANCED] = Field(
        0.03,
        ge=0,
        description="Weight of differences between the logarithms of neighbouring texels of the "
        "environment. Raise it where it is noisy.",
    )
    harmonics_weight: Annotated[float, Unit("weight"), ADVANCED] = Field(
        0.01,
        ge=0,
        description="Weight of the harmonics' distance to what was shaded, once they are no longer seen.",
    )
    normal_propagation: Annotated[bool, EXPERIMENTAL] = Field(
        False, description="Hand normals on to neighbours now and then, those of what reflects best first."
    )

    residual_share: Annotated[float | None, Unit("share of iterations"), ADVANCED] = Field(
        None,
        ge=0,
        le=10,
        description="After the training, so many times its iterations fit residual colors: harmonics of what "
        "materials and light do not explain, all else kept. Pictures in the learnt light add them; "
        "relighting, edits and stages do not. 0 leaves them out.",
    )

    @field_validator("up_world")
    @classmethod
    def _has_a_length(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if not any(value):
            raise ValueError("must be a direction, of which one number at least is not 0")
        return value

    @field_validator("reflection_ray_slope")
    @classmethod
    def _is_positive(cls, value: tuple[float, float]) -> tuple[float, float]:
        if min(value) <= 0:  # one passes into the other by a constant factor
            raise ValueError("must be two numbers of more than 0")
        return value

    former_settings: ClassVar = {
        "secondary_share": FormerSetting(1),
        "environment_every": FormerSetting(ENVIRONMENT_EVERY, after="environment_height"),
        "hand_over": FormerSetting(list(SHADING_RAMP), after="environment_every"),
        "propagation_every": FormerSetting(PROPAGATION_EVERY, after="normal_propagation"),
        "propagation_until": FormerSetting(PROPAGATION_UNTIL, after="propagation_every"),
        "environment_rate": FormerSetting(ENVIRONMENT_RATE, after="propagation_until"),
        "first_albedo": FormerSetting(INITIAL_ALBEDO, after="environment_rate"),
        "first_metallic": FormerSetting(INITIAL_METALLIC, after="first_albedo"),
        "first_roughness": FormerSetting(INITIAL_ROUGHNESS, after="first_metallic"),
    }

    @property
    def smooth_weights(self) -> tuple[float, ...]:
        """Return the weight of the smoothness of each column of materials."""
        return (self.smooth_weight,) * 3 + (self.smooth_gloss_weight,) * 2

    def shading_ramp(self, training_progress: float) -> float:
        """Return the share of the picture that is shaded, not taken from the harmonics."""
        begin, end = SHADING_RAMP
        if training_progress >= end:
            return 1.0
        return max(training_progress - begin, 0.0) / (end - begin)

    def blur_roughness(self, training_progress: float) -> float:
        """Return the roughness of the level of the environment that leads reflected directions."""
        return self.blur * max(0.0, 1.0 - training_progress / self.blur_until) if self.blur_until > 0 else 0.0

    def min_facet_slope(self, training_progress: float) -> float:
        """Return the tangent of the least angle between a normal and its facets."""
        first, last = self.reflection_ray_slope
        share = min(training_progress / self.blur_until, 1.0) if self.blur_until > 0 else 1.0
        return first * (last / first) ** share
