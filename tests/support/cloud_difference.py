"""How far two readings of the same Gaussians lie apart."""

from dataclasses import dataclass

import numpy as np

from octasplat.engine.gaussians.flattening import GaussianCloud


@dataclass(frozen=True)
class GaussianDifference:
    """Largest differences: world units, degrees, ln, opacity, coefficients."""

    position: float
    rotation_degrees: float
    log_scale: float
    opacity: float
    sh: float

    def assert_below(self, **limits: float) -> None:
        for name, limit in limits.items():
            assert getattr(self, name) <= limit, (
                f"{name} differs by {getattr(self, name):.4g}, not {limit:.4g}"
            )


def difference(a: GaussianCloud, b: GaussianCloud) -> GaussianDifference:
    assert a.means_world.shape == b.means_world.shape
    assert a.sh.shape == b.sh.shape
    return GaussianDifference(
        float(np.abs(a.means_world - b.means_world).max()),
        float(rotation_degrees(a.quats_wxyz, b.quats_wxyz).max()),
        float(np.abs(a.log_scales - b.log_scales).max()),
        float(np.abs(sigmoid(a.opacity_logits) - sigmoid(b.opacity_logits)).max()),
        float(np.abs(a.sh - b.sh).max()),
    )


def rotation_degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between rotations, by the chord so that small ones are exact."""
    unit_a, unit_b = (q.astype(np.float64) / np.linalg.norm(q, axis=1, keepdims=True) for q in (a, b))
    chord = np.minimum(np.linalg.norm(unit_a - unit_b, axis=1), np.linalg.norm(unit_a + unit_b, axis=1))
    return np.degrees(4.0 * np.arcsin(np.minimum(chord / 2.0, 1.0)))


def sigmoid(logits: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-logits.astype(np.float64)))
