"""Denoising by Open Image Denoise (https://www.openimagedenoise.org), if installed."""

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.pathtracing.film import DenoiseFn


def load_denoiser() -> DenoiseFn:
    """Return the function that denoises linear images.

    Raises:
        ConfigError: Open Image Denoise is not installed.
    """
    try:
        import pyoidn
    except (ImportError, OSError) as error:
        raise ConfigError(
            "integrator.denoise needs Open Image Denoise, which is not installed or does not run here "
            f"({error}); pip install octasplat[denoise], or leave denoise out."
        ) from None

    def clean(
        rgb_linear: Float32[np.ndarray, "h w 3"],
        albedo_linear: Float32[np.ndarray, "h w 3"] | None,
        normals_world: Float32[np.ndarray, "h w 3"] | None,
    ) -> Float32[np.ndarray, "h w 3"]:
        return np.asarray(
            pyoidn.denoise(rgb_linear, albedo=albedo_linear, normal=normals_world, hdr=True), np.float32
        )

    return clean
