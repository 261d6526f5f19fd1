"""The shading model of each recipe of materials: the only place that tells recipes apart."""

from collections.abc import Mapping

from octasplat.engine.shading.deferred import DeferredShading
from octasplat.engine.shading.material_settings import Recipe
from octasplat.engine.shading.ref_gaussian import RefGaussianShading

_MODELS: Mapping[Recipe, type[DeferredShading]] = {
    "split_sum": DeferredShading,
    "ref_gaussian": RefGaussianShading,
}


def material_shading(recipe: Recipe) -> type[DeferredShading]:
    """Return the shading model with which a recipe learns materials."""
    return _MODELS[recipe]
