"""Gaussians beside a mirror in Mitsuba 3.

Its integrator of Gaussians (``volprim_rf_basic``) ends a ray at anything that is not a Gaussian. So a ray is
followed in parts: Gaussians up to the mirror, Mitsuba's own mirror, Gaussians behind it; what the first part
lets through is 1 less what it shows of the same Gaussians in white.
"""

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from octasplat.engine.gaussians.model import SH_C0, FlatGaussians
from octasplat.engine.trace.protocol import TraceSettings

VARIANT = "llvm_ad_rgb"
THIN = 1e-5


def ellipsoids(gaussians: FlatGaussians, extent: float) -> dict[str, Any]:
    """Flat Gaussians as Mitsuba's ellipsoids, cut off at so many standard deviations.

    Ours have the normal as first axis and no thickness along it, so that the thin scale goes first.
    """
    count = len(gaussians)
    scales = np.concatenate([np.full((count, 1), THIN, np.float32), gaussians.scales], axis=1)
    quats = gaussians.quats_wxyz / np.linalg.norm(gaussians.quats_wxyz, axis=1, keepdims=True)
    return {
        "type": "ellipsoidsmesh",
        "centers": mi.TensorXf(gaussians.means_world),
        "scales": mi.TensorXf(scales),
        "quaternions": mi.TensorXf(quats[:, [1, 2, 3, 0]].astype(np.float32)),
        "opacities": mi.TensorXf(gaussians.opacities.reshape(-1, 1)),
        "sh_coeffs": mi.TensorXf(gaussians.sh.reshape(count, -1)),
        "extent": extent,
    }


class GaussiansBesideMirror:
    """Follows rays of a camera through Gaussians, off a mirror, and on through Gaussians.

    Args:
        gaussians: as they are trained.
        mirror_world: triangles that reflect everything, three corners each.
        settings: where rays are cut off.
    """

    def __init__(self, gaussians: FlatGaussians, mirror_world: np.ndarray, settings: TraceSettings) -> None:
        mi.set_variant(VARIANT)
        mesh = mi.Mesh("mirror", 3 * len(mirror_world), len(mirror_world))
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = mirror_world.ravel()
        parameters["faces"] = np.arange(3 * len(mirror_world), dtype=np.uint32)
        parameters.update()
        white = replace(gaussians, sh=np.full((len(gaussians), 1, 3), 0.5 / SH_C0, np.float32))
        extent = settings.q**0.5
        self._colored = mi.load_dict({"type": "scene", "a": ellipsoids(gaussians, extent), "b": mesh})
        self._white = mi.load_dict({"type": "scene", "a": ellipsoids(white, extent), "b": mesh})
        self._mirror = mi.load_dict({"type": "scene", "b": mesh})
        self._bsdf = mi.load_dict({"type": "twosided", "a": {"type": "conductor", "material": "none"}})
        self._integrator = mi.load_dict(
            {"type": "volprim_rf_basic", "max_depth": settings.max_hits, "srgb_primitives": False}
        )
        self._sampler = mi.load_dict({"type": "independent"})

    def trace(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Display colors of rays from one point, over black."""
        rays = self._rays(origin, directions)
        covered = self._follow(self._white, rays)
        front, behind, met = self._both(rays)
        return np.array(front + dr.select(met, (1.0 - covered) * behind, 0.0)).T

    def follow(self, origin: np.ndarray, directions: np.ndarray) -> None:
        """The work of :meth:`trace` but for what the front lets through, which an integrator would know."""
        self._both(self._rays(origin, directions))
        dr.sync_thread()

    def _rays(self, origin: np.ndarray, directions: np.ndarray) -> Any:
        start = mi.Point3f(*(mi.Float(float(x)) for x in origin)) + mi.Vector3f(0)
        return mi.Ray3f(start, mi.Vector3f(directions.T))

    def _both(self, rays: Any) -> tuple[Any, Any, Any]:
        """Colors in front of the mirror and behind it, and whether there is one."""
        met = self._mirror.ray_intersect(rays)
        sample, _ = self._bsdf.sample(mi.BSDFContext(), met, 0.5, mi.Point2f(0.5))
        on = met.spawn_ray(met.to_world(sample.wo))
        front = self._follow(self._colored, rays)
        return front, self._follow(self._colored, on, met.is_valid()), met.is_valid()

    def _follow(self, scene: Any, rays: Any, active: Any = True) -> Any:
        with dr.suspend_grad():
            out, _, _, _ = self._integrator.sample(
                dr.ADMode.Primal, scene, self._sampler, rays, None, None, mi.Bool(active)
            )
            dr.eval(out)
        return out
