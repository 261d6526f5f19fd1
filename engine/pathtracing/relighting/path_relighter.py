"""Relighting by path tracing: a camera's images under an environment."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.core.rays import ImageRays
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.pathtracing.compile_meshes import compile_meshes
from octasplat.engine.pathtracing.environment import EnvironmentMap
from octasplat.engine.pathtracing.gaussian_layers import build_gaussian_layers
from octasplat.engine.pathtracing.lights import build_light_arrays, eval_environment_map
from octasplat.engine.pathtracing.path_tracer import PathTracer, PathTracerScene
from octasplat.engine.pathtracing.relighting.relighter import ProgressCallback, RelitImage, no_progress
from octasplat.engine.pathtracing.stage.model import Integrator, Stage, StageGaussians
from octasplat.engine.trace.protocol import TraceSettings


class PathRelighter:
    """Relighting by path tracing: correct up to noise, with all shadows and interreflection.

    Args:
        gaussians: a scene with materials.
        settings: where rays are cut off.
        integrator: samples, depth and seed.
        threads: to use; 0 takes all.
    """

    def __init__(
        self, gaussians: FlatGaussians, settings: TraceSettings, integrator: Integrator, *, threads: int = 0
    ) -> None:
        stage = Stage(gaussians=(StageGaussians(light="relit"),), integrator=integrator)
        self._layers = build_gaussian_layers(
            stage, gaussians, _refuse_file, Path(), settings, size=1.0, threads=threads
        )
        self._meshes = compile_meshes(stage, Path(), threads=threads)
        self._integrator = integrator
        self._threads = threads
        self._tracer: PathTracer | None = None

    def set_environment(self, environment: EnvironmentMap) -> None:
        """Set the environment light."""
        lights = build_light_arrays((), environment.frame[1], environment)
        meshes = self._meshes.with_lights(lights)
        self._tracer = PathTracer(
            PathTracerScene(meshes, self._layers), self._integrator, threads=self._threads
        )

    def render(self, image: ImageRays, progress: ProgressCallback = no_progress) -> RelitImage:
        """Return the camera's image; ``progress`` is called with the fraction done."""
        assert self._tracer is not None, "an environment must be put first"
        film = self._tracer.render(image, lambda done, of: progress(done / of))
        return RelitImage(*film.gaussian_surface())


def render_environment(environment: EnvironmentMap, image: ImageRays) -> Float32[np.ndarray, "h w 3"]:
    """Return display values of the environment behind an image's pixels."""
    lights = build_light_arrays((), environment.frame[1], environment)
    directions: Float64[np.ndarray, "n 3"] = image.directions_world.reshape(-1, 3).astype(np.float64)
    radiance, _ = eval_environment_map(lights, directions)
    return linear_to_srgb(radiance).astype(np.float32).reshape(image.height_px, image.width_px, 3)


def _refuse_file(path: Path) -> FlatGaussians:
    raise AssertionError(f"{path}: nothing is read here")
