"""What renders a scene under an environment, and what it returns; imports no tracer."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.core.rays import ImageRays
from octasplat.engine.pathtracing.environment import EnvironmentMap

ProgressCallback = Callable[[float], None]


def no_progress(_share: float) -> None:
    """Ignore progress: the callback of callers who want none."""


@dataclass(frozen=True)
class RelitImage:
    """One relit image, without a background.

    Attributes:
        linear: radiance of what is seen of the scene, not multiplied by its coverage, without upper limit.
        coverage: how much of each pixel the scene covers.
    """

    linear: Float32[np.ndarray, "h w 3"]
    coverage: Float32[np.ndarray, "h w"]

    def composite_over(
        self, background_srgb: Float32[np.ndarray, "3"] | Float32[np.ndarray, "h w 3"]
    ) -> Float32[np.ndarray, "h w 3"]:
        """Return display values over a background, composited in display space; bright light exceeds 1."""
        covered = self.coverage[..., None]
        return np.asarray(covered * linear_to_srgb(self.linear) + (1 - covered) * background_srgb, np.float32)


@runtime_checkable
class Relighter(Protocol):
    """Renderer of a scene under an environment."""

    def set_environment(self, environment: EnvironmentMap) -> None:
        """Set the environment light."""
        ...

    def render(self, image: ImageRays, progress: ProgressCallback = no_progress) -> RelitImage:
        """Return the camera's image; ``progress`` is called with the fraction done."""
        ...
