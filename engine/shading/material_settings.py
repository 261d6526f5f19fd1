"""Every knob of learning materials and light from photographs, with its default."""

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

SEED_SECOND_STAGE = 0.36
"""Share of the training after which the seed's code begins deferred shading, with materials as at first."""
SEED_REACH = 10.0
"""World units within which the seed's code looks for what hides the environment."""
SEED_MATERIAL = (0.5, 0.5, 0.5, 0.01, 0.1)
"""Albedo, metallic and roughness that it begins deferred shading with."""


class MaterialSettings(BaseModel):
    """How materials and an environment are learnt; shares of the training are of all its iterations.

    Attributes:
        learn: whether they are; nothing else here matters if not.
        recipe: ``split_sum`` is this project's way; ``seed`` does what the code of "Reflective Gaussian
            Splatting" (https://arxiv.org/abs/2412.19282) does: the matt part is a colour of its own from the
            harmonics, the environment stays in [0, 1], everything is in display values, visibility is
            yes or no, and materials start over when deferred shading begins.
        up_world: up; with it :func:`octasplat.engine.shading.environment_frame.environment_frame` says which
            way the environment lies.
        environment_height: texels of the environment from up to down; it has twice as many around.
        environment_every: iterations between two steps of the environment.
        hand_over: when shading begins to replace the harmonics' colours, and when it has.
        secondary_from: when visibility and indirect light begin.
        visibility: whether what stands in the way of a reflection hides the environment there.
        parted: rays whose mean depth is farther from the median than so many times the distance at which
            reflected rays begin show two surfaces, which are shaded each by itself; 0 shades their mean.
        reflections: surfaces on the path of a reflected ray.
        facet_slope: least angle between a normal and the two facets beside it at which rays are reflected, at
            the beginning and from ``blur_until`` on; the rougher the surface, the larger.
        widened: share of the points that send a third reflected ray while training, by which roughness
            learns from how sharply other things are mirrored; 0 leaves that to the environment, which long
            trainings are better with.
        indirect: light of what stands there: ``shaded`` by the split sum, from the ``harmonics``, or
            ``none``.
        ambient: whether the irradiance is dimmed where other things hide the environment.
        bounced: whether matt surfaces are lit by what others send, too.
        ambient_rays: rays from each side of a Gaussian that say how much.
        ambient_parts: rebuilds of the hierarchy in which all Gaussians have their turn.
        hdr: whether the environment may be brighter than 1.
        reflected_gradient: whether normals learn through the reflected direction.
        normal_clip: gradients by normals through the reflected direction are cut off at so many times their
            median of a batch; 0 leaves them alone.
        start: distance from the surface at which reflected rays begin, of the extent.
        leaves: distance up to which they pass what they would meet from behind, likewise; for normals that
            point outwards.
        blur: roughness of the level that leads reflected directions at first, and sees farther than a
            sharp one; it falls to 0 until ``blur_until``.
        blur_until: see there.
        normal_weight: of the spread of the normals along a ray.
        depth_normal_weight: of the angle between normals and the surface that the depths span.
        smooth_normal_weight: of the angle between the normals of neighbouring rays.
        smooth_weight: of differences of albedo between neighbouring rays.
        smooth_gloss_weight: of differences of metallic and roughness between neighbouring rays, which change
            less over a thing than its colour does.
        smooth_metal: so many times more ``smooth_weight`` counts between metals, which are one colour more
            often and which have what is reflected wrongly painted on.
        only_seen: whether Gaussians that lie in no photograph are taken away; reflected rays alone see those,
            so that they would become lamps.
        white_weight: of the environment's colours; of their logarithms.
        even_weight: of differences between neighbouring texels; of their logarithms.
        harmonics_weight: of the harmonics' distance to what was shaded, once they are no longer seen.
        propagation: whether normals are handed on to neighbours now and then.
        propagation_every: share of the training between two times.
        propagation_until: share of the training at which it ends.
        environment_rate: size of a step of the environment's log radiance.
        first_albedo: what materials begin with.
        first_metallic: likewise.
        first_roughness: likewise.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    learn: bool = False
    recipe: Literal["split_sum", "seed"] = "split_sum"
    up_world: tuple[float, float, float] = (0.0, 0.0, 1.0)
    environment_height: int = Field(128, ge=16, le=512, multiple_of=8)
    environment_every: int = Field(4, ge=1)
    hand_over: tuple[float, float] = (0.0, 0.02)
    secondary_from: float = Field(0.05, ge=0, le=1)
    visibility: bool = True
    parted: float = Field(2.0, ge=0)
    reflections: int = Field(3, ge=1, le=8)
    facet_slope: tuple[float, float] = (0.1, 0.01)
    widened: float = Field(0.0, ge=0, le=1)
    indirect: Literal["shaded", "harmonics", "none"] = "shaded"
    ambient: bool = True
    bounced: bool = True
    ambient_rays: int = Field(16, ge=4)
    ambient_parts: int = Field(20, ge=1)
    hdr: bool = True
    reflected_gradient: bool = True
    normal_clip: float = Field(2.0, ge=0)
    start: float = Field(0.004, gt=0)
    leaves: float = Field(0.0, ge=0)
    blur: float = Field(0.5, ge=0, le=1)
    blur_until: float = Field(0.3, ge=0, le=1)
    normal_weight: float = Field(0.1, ge=0)
    depth_normal_weight: float = Field(0.1, ge=0)
    smooth_normal_weight: float = Field(0.1, ge=0)
    smooth_weight: float = Field(0.01, ge=0)
    smooth_gloss_weight: float = Field(0.08, ge=0)
    smooth_metal: float = Field(10.0, ge=0)
    only_seen: bool = True
    white_weight: float = Field(0.01, ge=0)
    even_weight: float = Field(0.03, ge=0)
    harmonics_weight: float = Field(0.01, ge=0)
    propagation: bool = False
    propagation_every: float = Field(0.06, gt=0, le=1)
    propagation_until: float = Field(0.4, ge=0, le=1)
    environment_rate: float = Field(0.03, ge=0)
    first_albedo: float = Field(0.5, gt=0, lt=1)
    first_metallic: float = Field(0.5, gt=0, lt=1)
    first_roughness: float = Field(0.3, gt=0, lt=1)

    @model_validator(mode="before")
    @classmethod
    def _without_secondary_share(cls, given: Any) -> Any:
        """Runs of earlier versions list a ``secondary_share``; 1 meant all pixels, as now."""
        if isinstance(given, dict) and given.get("secondary_share") == 1:
            given = {name: value for name, value in given.items() if name != "secondary_share"}
        return given

    @property
    def clears_unseen(self) -> bool:
        """Whether Gaussians that lie in no photograph are taken away; the seed lets them be."""
        return self.learn and self.only_seen and self.recipe != "seed"

    @property
    def smooth_weights(self) -> tuple[float, ...]:
        """Of the smoothness of each column of materials."""
        return (self.smooth_weight,) * 3 + (self.smooth_gloss_weight,) * 2

    def is_seed_deferred(self, progress: float) -> bool:
        """Whether the seed's second stage has begun."""
        return self.recipe == "seed" and progress >= SEED_SECOND_STAGE

    def handed_over(self, progress: float) -> float:
        """Share of the picture that is shaded, not taken from the harmonics."""
        begin, end = self.hand_over
        if progress >= end:
            return 1.0
        return max(progress - begin, 0.0) / (end - begin)

    def blurred(self, progress: float) -> float:
        """Roughness of the level that leads reflected directions."""
        return self.blur * max(0.0, 1.0 - progress / self.blur_until) if self.blur_until > 0 else 0.0

    def least_slope(self, progress: float) -> float:
        """Tangent of the least angle between a normal and its facets."""
        first, last = self.facet_slope
        share = min(progress / self.blur_until, 1.0) if self.blur_until > 0 else 1.0
        return first * (last / first) ** share
