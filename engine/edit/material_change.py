"""Changed materials of selected Gaussians, and harmonics refitted to them."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float64

from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.edit.edit_options import MaterialChange
from octasplat.engine.gaussians.channels import stack_channels
from octasplat.engine.gaussians.materials import AMBIENT, MATERIAL_WIDTHS
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.spherical_harmonics import fibonacci_sphere, sh_basis
from octasplat.engine.shading.kernels.environment_levels import EnvironmentLevels
from octasplat.engine.shading.split_sum import SurfacePoints, shade

_ROWS_PER_BLOCK = 1 << 14
_DIRECTIONS = 64
"""From which a Gaussian is looked at to see how its look changes."""


def with_materials(
    gaussians: FlatGaussians, chosen: Bool[np.ndarray, " n"], change: MaterialChange
) -> FlatGaussians:
    """Return the scene with the materials of the selected Gaussians changed; other arrays are shared."""
    values, factors = change.set.set_values(), change.multiply.set_values()
    changed = {name: gaussians.channels[name].copy() for name in (*values, *factors)}
    for name, value in values.items():
        changed[name][chosen] = value
    for name, factor in factors.items():
        changed[name][chosen] = np.clip(changed[name][chosen] * np.float32(factor), 0.0, 1.0)
    return gaussians.with_channels(changed)


def refit_sh(
    before: FlatGaussians,
    after: FlatGaussians,
    chosen: Bool[np.ndarray, " n"],
    light: EnvironmentLevels,
    frame: Float64[np.ndarray, "3 3"],
) -> FlatGaussians:
    """Return the changed scene with harmonics refitted to its materials, for renderers of harmonics.

    To those of each chosen Gaussian is added by how much its split sum differs between the two materials, in
    display values and from all directions, as nearly as its harmonics can say it. Its share of the light
    from all around stands for what it sees of the environment; a scene without that channel sees all.

    Args:
        before: the scene as it was.
        after: the same with other materials.
        chosen: whose harmonics follow.
        light: levels of the environment that the scene was learnt with.
        frame: its right, up and forward in the world, as rows.
    """
    directions_world = fibonacci_sphere(_DIRECTIONS)
    solve = np.linalg.pinv(sh_basis(directions_world, after.sh_degree))  # least squares over the directions
    sh, rows = after.sh.copy(), np.flatnonzero(chosen)
    for start in range(0, len(rows), _ROWS_PER_BLOCK):
        part = rows[start : start + _ROWS_PER_BLOCK]
        colors = [
            _shaded_colors(scene.select(part), directions_world, light, frame) for scene in (before, after)
        ]
        sh[part] += np.einsum("kd,ndc->nkc", solve, colors[1] - colors[0]).astype(np.float32)
    return replace(after, sh=sh)


def _shaded_colors(
    gaussians: FlatGaussians,
    directions_world: Float64[np.ndarray, "d 3"],
    light: EnvironmentLevels,
    frame: Float64[np.ndarray, "3 3"],
) -> Float64[np.ndarray, "n d 3"]:
    """Return the display colors of Gaussians seen along directions."""
    count, views = len(gaussians), len(directions_world)
    directions = np.tile(directions_world, (count, 1))
    normals = np.repeat(gaussians.rotations[:, :, 0].astype(np.float64), views, axis=0)
    # Normals face the viewer, whom directions lead away from.
    normals *= np.where((normals * directions).sum(axis=1) > 0, -1.0, 1.0)[:, None]
    material = np.repeat(stack_channels(gaussians.channels, list(MATERIAL_WIDTHS)), views, axis=0)
    surface = SurfacePoints.unoccluded(material, normals, directions)
    if AMBIENT in gaussians.channels:
        ambient = np.repeat(gaussians.channels[AMBIENT][:, 0].astype(np.float64), views)
        surface = replace(surface, visibility=ambient, ambient=ambient)
    display = linear_to_srgb(np.minimum(shade(surface, light, frame), 1.0))
    return display.reshape(count, views, 3)
