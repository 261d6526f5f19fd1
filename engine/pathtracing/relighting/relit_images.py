"""Images of a scene under one or several environments, each shot with its own lighting."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from octasplat.engine.core.color import linear_to_srgb, srgb_to_linear
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.pathtracing.environment import EnvironmentMap, environment_frame
from octasplat.engine.pathtracing.relighting.path_relighter import render_environment
from octasplat.engine.pathtracing.relighting.relighter import Relighter
from octasplat.engine.render.environment_files import read_environment
from octasplat.engine.render.image_files import write_exr, write_png
from octasplat.engine.render.renderer import background_color
from octasplat.engine.render.shots import Shot

RadianceMap = Float32[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class ShotLighting:
    """The lighting of one shot.

    Attributes:
        environment: name of the map.
        rotation_degrees: how far it is turned about the vertical.
    """

    environment: str
    rotation_degrees: float


def read_environments(
    paths: Sequence[Path], clamp: float | None, warn: Callable[[str], None]
) -> dict[str, RadianceMap]:
    """Read environment maps.

    Args:
        paths: of HDR or EXR images.
        clamp: radiance at which they are cut off; None for no limit.
        warn: called with a sentence on what of an image is odd, or replaced.

    Returns:
        The maps by the names of their files, without suffixes.

    Raises:
        ConfigError: one cannot be used, or two have one name.
    """
    found: dict[str, RadianceMap] = {}
    for path in paths:
        if path.stem in found:
            raise ConfigError(f"{path}: two environments are called {path.stem}; rename one.")
        found[path.stem] = np.minimum(
            read_environment(path, warn), np.float32(np.inf if clamp is None else clamp)
        )
    return found


def lit_shots(
    environments: Sequence[str], shots: Sequence[Shot], rotation_degrees: float, *, spin: bool
) -> dict[Shot, ShotLighting]:
    """Return all shots under all environments, in folders named like these if there are several.

    Args:
        environments: their names.
        shots: the cameras.
        rotation_degrees: turns all environments.
        spin: turn each environment once round from the first shot to the last.
    """
    several = len(environments) > 1
    return {
        Shot(f"{name}/{shot.name}" if several else shot.name, shot.rays): ShotLighting(
            name, rotation_degrees + (360.0 * k / len(shots) if spin else 0.0)
        )
        for name in environments
        for k, shot in enumerate(shots)
    }


@dataclass
class RelitRenderFn:
    """Render function of shots under their lighting.

    ``.exr`` gets linear R, G, B and alpha A, anything else 8-bit display values.

    Args:
        relighter: of the scene.
        environments: maps by name.
        up_world: the vertical.
        background: ``black``, ``white``, ``transparent``, or ``environment``.
        lightings: the light on each shot.
    """

    relighter: Relighter
    environments: Mapping[str, RadianceMap]
    up_world: Float64[np.ndarray, "3"]
    background: str
    lightings: Mapping[Shot, ShotLighting]
    _lighting: ShotLighting | None = field(default=None, repr=False)
    _map: EnvironmentMap | None = field(default=None, repr=False)

    def __call__(self, shot: Shot, path: Path, progress: Callable[[float], None]) -> None:
        """Render and write one shot.

        Raises:
            OutputError: the file cannot be written.
        """
        environment = self._set_lighting(self.lightings[shot])
        rays = shot.rays()
        image = self.relighter.render(rays, progress)
        is_exr = path.suffix.lower() == ".exr"
        if self.background == "transparent" and not is_exr:
            write_png(path, np.clip(linear_to_srgb(image.linear), 0, 1), image.coverage)
            return
        plain = background_color("white" if self.background == "white" else "black")
        rgb = image.composite_over(
            render_environment(environment, rays) if self.background == "environment" else plain
        )
        if is_exr:
            is_transparent = self.background == "transparent"
            linear = image.linear * image.coverage[..., None] if is_transparent else srgb_to_linear(rgb)
            write_exr(path, {**{name: linear[..., k] for k, name in enumerate("RGB")}, "A": image.coverage})
        else:
            write_png(path, np.clip(rgb, 0, 1))

    def _set_lighting(self, lighting: ShotLighting) -> EnvironmentMap:
        if self._map is None or self._lighting != lighting:
            frame = environment_frame(self.up_world, lighting.rotation_degrees)
            self._map = EnvironmentMap(self.environments[lighting.environment], frame)
            self._lighting = lighting
            self.relighter.set_environment(self._map)
        return self._map
