"""Masks of selected Gaussians: by boxes, spheres, meshes, masks and expressions."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.local_origin import NO_ORIGIN, Origin
from octasplat.engine.dataset.region import Region
from octasplat.engine.edit.edit_options import Selection
from octasplat.engine.edit.exported_radii import exported_radii
from octasplat.engine.edit.filter_expression import filter_mask
from octasplat.engine.edit.mesh_identity import check_mesh_of_scene
from octasplat.engine.edit.octagon_matching import match_octagons
from octasplat.engine.files import ImportedMesh
from octasplat.engine.gaussians.model import FlatGaussians


def selection_mask(
    gaussians: FlatGaussians, selection: Selection, origin_world: Origin = NO_ORIGIN
) -> Bool[np.ndarray, " n"]:
    """Return a mask of the Gaussians that a selection holds for.

    Args:
        gaussians: the scene.
        selection: in the coordinates of the user.
        origin_world: where the scene has its origin in these.

    Raises:
        ConfigError: the expression names what the scene does not have, or a box or sphere is none.
    """
    chosen = np.ones(len(gaussians), dtype=bool)
    origin = np.array(origin_world)
    if selection.where is not None:
        chosen &= filter_mask(gaussians, selection.where, origin_world)
    if (box := selection.box) is not None:
        chosen &= in_box(gaussians, np.array(box[:3]) - origin, np.array(box[3:]) - origin)
    if (sphere := selection.sphere) is not None:
        chosen &= in_sphere(gaussians, np.array(sphere[:3]) - origin, sphere[3])
    return ~chosen if selection.inverse else chosen


def in_box(
    gaussians: FlatGaussians, low_world: Float[np.ndarray, "3"], high_world: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, " n"]:
    """Return which centres lie in a box along the world's axes, its faces included.

    Raises:
        ConfigError: some side has a negative length.
    """
    low, high = np.asarray(low_world, np.float64), np.asarray(high_world, np.float64)
    if not (low <= high).all():
        raise ConfigError("A box needs its smallest x, y, z first and then its largest ones.")
    x0, y0, z0, x1, y1, z1 = np.concatenate([low, high]).tolist()
    return Region((x0, y0, z0, x1, y1, z1)).contains(gaussians.means_world)


def in_sphere(
    gaussians: FlatGaussians, centre_world: Float[np.ndarray, "3"], radius_world: float
) -> Bool[np.ndarray, " n"]:
    """Return which centres lie in a sphere.

    Raises:
        ConfigError: the radius is not positive.
    """
    if not radius_world > 0.0:
        raise ConfigError("The radius of a sphere must be positive.")
    offsets = gaussians.means_world.astype(np.float64) - np.asarray(centre_world, np.float64)
    result: np.ndarray = np.linalg.norm(offsets, axis=1) <= radius_world
    return result


def in_mesh(gaussians: FlatGaussians, mesh: ImportedMesh, path: Path) -> Bool[np.ndarray, " n"]:
    """Return which Gaussians have their octagon in a mesh exported from the scene, wherever it lies now.

    Args:
        gaussians: the scene.
        mesh: what is left of its octagons after others were deleted in a mesh editor.
        path: its file, named in errors.

    Raises:
        SceneFileError: the mesh does not belong to the scene, or its vertices cannot be identified.
    """
    opacities = gaussians.opacities
    _, radii = exported_radii(mesh, opacities)
    octagons = match_octagons(path, mesh, opacities, radii)
    check_mesh_of_scene(path, mesh, octagons, gaussians.with_base_color_only(), radii)
    chosen = np.zeros(len(gaussians), dtype=bool)
    chosen[octagons.gids] = True
    return chosen
