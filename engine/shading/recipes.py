"""The shading model of each recipe of materials: the only place that tells recipes apart."""

from collections.abc import Mapping

from octasplat.engine.shading.deferred import DeferredShading
from octasplat.engine.shading.material_settings import Recipe
from octasplat.engine.shading.near_field import NearFieldShading
from octasplat.engine.shading.ref_gaussian import RefGaussianShading

_MODELS: Mapping[Recipe, type[DeferredShading]] = {
    "split_sum": DeferredShading,
    "ref_gaussian": RefGaussianShading,
    "near_field": NearFieldShading,
}


def material_shading(recipe: Recipe) -> type[DeferredShading]:
    """Return the shading model with which a recipe learns materials."""
    return _MODELS[recipe]


def relighting_shading(recipe: Recipe) -> type[DeferredShading]:
    """Return the shading model with which scenes of a recipe are lit anew.

    Harmonics that hold the light of what stands around, as those of near fields do, cannot be lit.
    """
    return DeferredShading if recipe == "near_field" else material_shading(recipe)
