"""Relighting by the split sum: fast, with the shading of the training."""

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.rays import ImageRays
from octasplat.engine.gaussians.materials import AMBIENT, with_interreflection_channel
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.pathtracing.environment import EnvironmentMap
from octasplat.engine.pathtracing.relighting.relighter import ProgressCallback, RelitImage, no_progress
from octasplat.engine.render.supersampling import pixel_means
from octasplat.engine.shading.material_settings import MaterialSettings
from octasplat.engine.shading.recipes import relighting_shading
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import TraceSettings

ENVIRONMENT_HEIGHT_PX = 256
"""Texels of the environment from up to down."""


class SplitSumRelighter:
    """Deferred shading with traced visibility; reflected hits are shaded by the split sum, too.

    Follows :class:`octasplat.engine.pathtracing.relighting.relighter.Relighter`.

    Args:
        gaussians: a scene with materials.
        settings: where rays are cut off.
        material_settings: how the materials were learnt; None for a scene of which that is not known.
        extent_world: radius of the cameras, the unit of the distance at which reflected rays begin.
        rays_across_pixel: so many rays across a pixel, and as many down.
        threads: to use; 0 takes all.
    """

    def __init__(
        self,
        gaussians: FlatGaussians,
        settings: TraceSettings,
        material_settings: MaterialSettings | None,
        *,
        extent_world: float,
        rays_across_pixel: int = 2,
        threads: int = 0,
    ) -> None:
        self._rays_across_pixel = rays_across_pixel
        changed = {
            "learn": True,
            "environment_height": ENVIRONMENT_HEIGHT_PX,
            "visibility": True,
            "indirect": "shaded",
        }
        shading = (material_settings or MaterialSettings()).model_copy(update=changed)
        self._shading = relighting_shading(shading.recipe)(
            shading, extent_world=extent_world, one_sided=settings.flip_normal_cos > 0
        )
        self._gaussians = with_interreflection_channel(gaussians)
        self._tracer = make_tracer(settings, threads=threads, build_quality=2)
        self._tracer.build(self._gaussians, self._shading.features(self._gaussians))
        self._all = np.arange(len(gaussians))
        self._open_sides: Float32[np.ndarray, " n"] | None = None
        if AMBIENT in gaussians.channels and shading.ambient_occlusion:
            self._open_sides = self._shading.measure_ambient_occlusion(
                self._gaussians, self._all, self._tracer
            )
        self._radiance: Float32[np.ndarray, "h w 3"] | None = None

    def set_environment(self, environment: EnvironmentMap) -> None:
        """Set the environment light."""
        other = self._radiance is not environment.radiance_linear
        if other:
            self._shading.relight_with(environment.radiance_linear)
            self._radiance = environment.radiance_linear
        if other or not np.array_equal(self._shading.frame, environment.frame):
            self._shading.frame = environment.frame
            if self._open_sides is not None:
                self._shading.measure_diffuse_interreflection(
                    self._gaussians, self._all, self._open_sides, self._tracer
                )

    def render(self, image: ImageRays, progress: ProgressCallback = no_progress) -> RelitImage:
        """Return the camera's image; ``progress`` is called with the fraction done."""
        assert self._radiance is not None, "an environment must be put first"
        found = pixel_means(self._tracer, image, self._shading, self._rays_across_pixel, progress)
        return RelitImage(found.linear, found.alpha)
