"""Radii that the octagons of a mesh were exported with: Q, and what an opaque export cut off."""

import math

import numpy as np
from jaxtyping import Float, Float64

from octasplat.engine.files import ImportedMesh
from octasplat.engine.files.octagon_glb_layout import OPAQUE_CUTOFF
from octasplat.engine.gaussians.octagon import APOTHEM, CHI2_2_99, CHI2_3_99, SIDES, cut_octagon_radii

Q_TOLERANCE = 1e-3
MAX_SPREAD = 1e-3
"""Texture coordinates of octagons agree on their Q to this share of it, in an editor's 16 bits, too."""
MAX_ORDER_SPREAD = 0.01
"""Likewise of octagons without numbers, some nearly opaque, of which texture coordinates say little."""


def exported_radii(
    mesh: ImportedMesh, opacities: Float[np.ndarray, " n"], q: float | None = None
) -> tuple[float, Float[np.ndarray, " n"]]:
    """Return the Q of an export, and the corner radii of all octagons in standard deviations, 0 for none.

    Args:
        mesh: as read.
        opacities: of the Gaussians of the scene.
        q: what the user says.
    """
    cutoff, inferred = mesh.alpha_cutoff, None
    if cutoff is not None and not 0.0 < cutoff < 1.0:
        cutoff = None
    if cutoff is None and mesh.q is None and mesh.radius is None:
        inferred = _q_of_opaque(mesh, opacities)
        cutoff = None if inferred is None else OPAQUE_CUTOFF
    q = q or inferred or infer_q(mesh, opacities, CHI2_2_99)
    return q, cut_octagon_radii(opacities, q, cutoff)


def infer_q(mesh: ImportedMesh, opacities: Float[np.ndarray, " n"], default: float) -> float:
    """Return the Q of an export: as the file states it, else estimated from its octagons, else a default.

    A radius is sqrt(Q + 2 ln a) for opacity a, and the texture coordinates hold radius / sqrt(Q).
    """
    if mesh.q is not None and np.isfinite(mesh.q) and mesh.q > 0:
        return mesh.q
    if mesh.gid is None:
        return _q_by_order(mesh, opacities) or default
    vertices, logs = _known_opacities(mesh.gid, opacities)
    estimates = np.zeros(0)
    if mesh.radius is not None:
        estimates = mesh.radius[vertices].astype(np.float64) ** 2 - 2 * logs  # Q = radius^2 - 2 ln a
    elif mesh.uv is not None:
        squares = _squared_shares(mesh.uv[vertices])
        with np.errstate(divide="ignore", invalid="ignore"):
            # squares = radius^2 / Q = 1 + 2 ln a / Q; near 1, for opacities near 1, it says nothing of Q.
            estimates = np.where(squares < 0.9, 2 * logs / (squares - 1), np.nan)
    estimates = estimates[np.isfinite(estimates) & (estimates > 0)]
    return _snap_q(float(np.median(estimates))) if len(estimates) else default


def _q_by_order(mesh: ImportedMesh, opacities: Float[np.ndarray, " n"]) -> float | None:
    """Return the Q that texture coordinates say of octagons in the order of the scene; None if none.

    Those of the most opaque Gaussians are there, as an export leaves out the faintest. Where their order has
    changed, no Q fits most of them.
    """
    count, rest = divmod(len(mesh), SIDES)
    if mesh.uv is None or rest or not 0 < count <= len(opacities):
        return None
    own = opacities[opacities >= np.sort(opacities)[len(opacities) - count]].astype(np.float64)
    if len(own) != count:  # equally faint ones, only some of which are there
        return None
    squares = _squared_shares(mesh.uv).reshape(count, SIDES).mean(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        estimates = 2 * np.log(np.maximum(own, 1e-30)) / (squares - 1)
    for nearest in (0.9, 0.999):  # nearer to 1 they say little, but may be all that there is
        q, spread = _middle_and_spread(estimates[squares < nearest])
        if q > 0 and spread < MAX_ORDER_SPREAD * q:
            return _snap_q(q, max(Q_TOLERANCE, 3.0 * spread / q))
    return None


def _snap_q(q: float, tolerance: float = Q_TOLERANCE) -> float:
    """Return the nearest round value of Q, where rounding in the file left it a little off."""
    for chosen in (CHI2_2_99, CHI2_3_99, round(q, 2)):
        if abs(q - chosen) <= tolerance * q:
            return chosen
    return q


def _q_of_opaque(mesh: ImportedMesh, opacities: Float[np.ndarray, " n"]) -> float | None:
    """Return the Q of an opaque export whose file does not say so any more; None of any other mesh.

    Its octagons have the squared radius (2 ln a - 2 ln cutoff) / apothem^2, the others Q + 2 ln a; texture
    coordinates hold the root of that over Q, so that only one of both gives the same Q everywhere.
    """
    if mesh.gid is None or mesh.uv is None:
        return None
    vertices, logs = _known_opacities(mesh.gid, opacities)
    squares = _squared_shares(mesh.uv[vertices])
    with np.errstate(divide="ignore", invalid="ignore"):
        estimates = (2 * logs - 2 * math.log(OPAQUE_CUTOFF)) / (APOTHEM**2 * squares)
        others = 2 * logs / (squares - 1)
    q, spread = _middle_and_spread(estimates)
    if not (q > 0 and spread < MAX_SPREAD * q):
        return None
    # where all Gaussians are alike both fit, and an export is rarely opaque
    other_q, other_spread = _middle_and_spread(others)
    return None if other_q > 0 and other_spread < MAX_SPREAD * other_q else _snap_q(q)


def _middle_and_spread(values: Float64[np.ndarray, " k"]) -> tuple[float, float]:
    """Return the median of the finite values, and that of their distances from it."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, math.inf
    middle = float(np.median(finite))
    return middle, float(np.median(np.abs(finite - middle)))


def _known_opacities(
    gid: Float[np.ndarray, " v"], opacities: Float[np.ndarray, " n"]
) -> tuple[np.ndarray, Float64[np.ndarray, " k"]]:
    """Return the vertices whose Gaussian is known, and the logarithms of its opacity."""
    with np.errstate(invalid="ignore"):
        known = np.isfinite(gid) & (gid > -0.5) & (gid < len(opacities) - 0.5)
        known &= np.abs(gid - np.round(gid)) < 1e-3
    vertices = np.flatnonzero(known)
    own = opacities[np.round(gid[vertices]).astype(np.int64)].astype(np.float64)
    return vertices, np.log(np.maximum(own, 1e-30))


def _squared_shares(uv: Float[np.ndarray, "k 2"]) -> Float64[np.ndarray, " k"]:
    """Return squared radius / Q of corners with these texture coordinates."""
    return np.asarray(4 * np.sum((uv.astype(np.float64) - 0.5) ** 2, axis=-1))
