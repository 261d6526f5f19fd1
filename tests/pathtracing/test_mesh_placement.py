"""How meshes are turned to the stage's up."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from octasplat.engine.pathtracing.mesh_shapes import align_axis_to_up

AXES = ("x", "-x", "y", "-y", "z", "-z")


def unit(axis: str) -> np.ndarray:
    return np.eye(3)["xyz".index(axis[-1])] * (-1.0 if axis.startswith("-") else 1.0)


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("up", AXES)
def test_an_up_that_is_nearly_an_axis_turns_meshes_as_that_axis_does(axis: str, up: str) -> None:
    exact = align_axis_to_up(axis, unit(up))
    np.testing.assert_allclose(exact @ unit(axis), unit(up), atol=1e-12)
    for tilt in np.random.default_rng(0).normal(scale=0.02, size=(20, 3)):
        nearly = unit(up) + tilt
        found = align_axis_to_up(axis, nearly)
        nearly /= np.linalg.norm(nearly)
        np.testing.assert_allclose(found @ unit(axis), nearly, atol=1e-12)
        assert np.linalg.det(found) == pytest.approx(1.0)
        turned = Rotation.from_matrix(found @ exact.T).magnitude()
        assert turned < 2.1 * np.arccos(min(nearly @ unit(up), 1.0)) + 1e-9


def test_an_axis_to_its_opposite_is_half_a_turn_about_x() -> None:
    np.testing.assert_array_equal(align_axis_to_up("y", np.array([0.0, -1.0, 0.0])), np.diag([1.0, -1, -1]))
