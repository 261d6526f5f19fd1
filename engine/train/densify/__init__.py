"""Strategies that add, move and remove Gaussians while training, behind one protocol."""

from octasplat.engine.train.config import McmcConfig, PaperConfig
from octasplat.engine.train.densify.mcmc import Mcmc
from octasplat.engine.train.densify.protocol import Densifier
from octasplat.engine.train.densify.redisplats import Paper

__all__ = ["Densifier", "Mcmc", "Paper", "make_densifier"]


def make_densifier(config: McmcConfig | PaperConfig, *, iterations: int, max_gaussians: int) -> Densifier:
    """The strategy that ``config`` describes, for so many iterations and at most so many Gaussians."""
    if isinstance(config, McmcConfig):
        return Mcmc(config, iterations=iterations, max_gaussians=max_gaussians)
    return Paper(config, iterations=iterations, max_gaussians=max_gaussians)
