"""What deferred shading keeps of a batch for its backward pass and for the layers of a finished picture."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from octasplat.engine.shading.depth_split import DepthLayers
from octasplat.engine.shading.gbuffer import GBuffer
from octasplat.engine.shading.incident_light import IncidentLightModel
from octasplat.engine.shading.protocol import LINEAR
from octasplat.engine.shading.split_sum import SurfacePoints


@dataclass(frozen=True)
class ShadingContext:
    """Result of shading a batch; see :class:`octasplat.engine.shading.deferred.DeferredShading`.

    Attributes:
        depth_layers: the layers that were shaded separately, ``l`` of ``r`` rays.
        gbuffer: blended materials, normals and positions of the ``p`` shaded points.
        surface: the points as they were shaded.
        linear: their radiance.
        display: their colors as shown.
        incident: light along reflected directions; None where none was traced.
        ramp: share of the picture that is shaded, not taken from the harmonics, as far as training has come.
        share: the same at each point.
    """

    depth_layers: DepthLayers
    gbuffer: GBuffer
    surface: SurfacePoints
    linear: Float64[np.ndarray, "p 3"]
    display: Float64[np.ndarray, "p 3"]
    incident: IncidentLightModel | None
    ramp: float
    share: Float64[np.ndarray, " p"]

    def named_layers(
        self, radiance_linear: Float64[np.ndarray, "p 3"]
    ) -> dict[str, Float32[np.ndarray, "r _"]]:
        """Return radiance, materials, visibility and indirect light by name, means over each ray's layers."""
        surface, material = self.surface, self.gbuffer.surface.material
        values = {
            LINEAR: radiance_linear,
            "albedo": material[:, :3],
            "metallic": material[:, 3:4],
            "roughness": material[:, 4:5],
            "visibility": surface.visibility[:, None],
            "indirect": surface.indirect_linear,
        }
        return self.depth_layers.ray_means(self.gbuffer.ray_ids, self.gbuffer.alpha, values)
