"""Strategies that add, move and remove Gaussians while training, behind one protocol."""

from octasplat.engine.dataset.region import Region
from octasplat.engine.train.config import McmcConfig, RedisplatsConfig
from octasplat.engine.train.densify.mcmc import McmcDensifier
from octasplat.engine.train.densify.protocol import Densifier
from octasplat.engine.train.densify.redisplats import RedisplatsDensifier

__all__ = ["Densifier", "McmcDensifier", "RedisplatsDensifier", "make_densifier"]


def make_densifier(
    config: McmcConfig | RedisplatsConfig,
    *,
    iterations: int,
    max_gaussians: int,
    region: Region | None = None,
) -> Densifier:
    """Return the strategy that ``config`` describes, for so many iterations and at most so many Gaussians.

    The strategy of the paper takes no note of a region.
    """
    if isinstance(config, McmcConfig):
        return McmcDensifier(config, iterations=iterations, max_gaussians=max_gaussians, region=region)
    return RedisplatsDensifier(config, iterations=iterations, max_gaussians=max_gaussians)
