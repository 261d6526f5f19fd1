"""Scenes with materials in another light by the split sum: fast, as they were learnt."""

import numpy as np
from jaxtyping import Float32

from octasplat.engine.gaussians.materials import AMBIENT, with_room_for_bounced
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.light.environment import EnvironmentMap
from octasplat.engine.light.relighting import Part, RelitImage, silent
from octasplat.engine.rays import ImageRays
from octasplat.engine.render.oversampling import pixel_means
from octasplat.engine.shading.deferred import Deferred
from octasplat.engine.shading.material_settings import MaterialSettings
from octasplat.engine.trace.make import make_tracer
from octasplat.engine.trace.protocol import TraceSettings

HEIGHT = 256
"""Texels of the environment from up to down."""


class SplitSumRelighter:
    """Deferred shading with traced visibility; what a reflected ray meets is shaded by the split sum itself.

    Follows :class:`octasplat.engine.light.relighting.Relighter`.

    Args:
        gaussians: a scene with materials.
        settings: where rays are cut off.
        learnt: how the materials were learnt; None for a scene of which that is not known.
        extent_world: radius of the cameras, the unit of the distance at which reflected rays begin.
        side: so many rays across a pixel, and as many down.
        threads: to use; 0 takes all.
    """

    def __init__(
        self,
        gaussians: FlatGaussians,
        settings: TraceSettings,
        learnt: MaterialSettings | None,
        *,
        extent_world: float,
        side: int = 2,
        threads: int = 0,
    ) -> None:
        self._across = side
        changed = {"learn": True, "environment_height": HEIGHT, "visibility": True, "indirect": "shaded"}
        shading = (learnt or MaterialSettings()).model_copy(update=changed)
        self._shading = Deferred(shading, extent_world=extent_world, sided=settings.flip_normal_cos > 0)
        self._gaussians = with_room_for_bounced(gaussians)
        self._tracer = make_tracer(settings, threads=threads, build_quality=2)
        self._tracer.build(self._gaussians, self._shading.features(self._gaussians))
        self._all = np.arange(len(gaussians))
        self._open_sides: Float32[np.ndarray, " n"] | None = None
        if AMBIENT in gaussians.channels and shading.ambient_occlusion:
            self._open_sides = self._shading.look_around(self._gaussians, self._all, self._tracer)
        self._radiance: Float32[np.ndarray, "h w 3"] | None = None

    def put(self, environment: EnvironmentMap) -> None:
        """Take this environment from now on."""
        other = self._radiance is not environment.radiance_linear
        if other:
            self._shading.light.put(environment.radiance_linear)
            self._radiance = environment.radiance_linear
        if other or not np.array_equal(self._shading.frame, environment.frame):
            self._shading.frame = environment.frame
            if self._open_sides is not None:
                self._shading.bounce(self._gaussians, self._all, self._open_sides, self._tracer)

    def render(self, image: ImageRays, part: Part = silent) -> RelitImage:
        """What a camera sees; ``part`` is told the share that is done."""
        assert self._radiance is not None, "an environment must be put first"
        found = pixel_means(self._tracer, image, self._shading, self._across, part)
        return RelitImage(found.linear, found.alpha)
