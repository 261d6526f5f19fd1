"""Quaternions (w, x, y, z) and the frames of flat Gaussians."""

import numpy as np
from jaxtyping import Float


def rotation_matrices(quats_wxyz: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 3 3"]:
    """Return rotation matrices of quaternions that need not be of unit length.

    Computed in float64 and returned in the input's precision.

    >>> rotation_matrices(np.array([[1.0, 0.0, 0.0, 1.0]])).round(6).tolist()  # 90 degrees about z
    [[[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]]
    """
    q = quats_wxyz.astype(np.float64)
    w, x, y, z = (q / np.linalg.norm(q, axis=-1, keepdims=True)).T
    rows = np.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ],
        axis=-1,
    )  # fmt: skip
    return rows.reshape(-1, 3, 3).astype(quats_wxyz.dtype)


def quaternions_from_matrices(rotations: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 4"]:
    """Return unit quaternions (w, x, y, z) with w >= 0 of proper rotation matrices.

    The largest of the four components is found first and the others follow from it, which is stable for
    every rotation.

    >>> quaternions_from_matrices(np.eye(3)[None]).tolist()
    [[1.0, 0.0, 0.0, 0.0]]
    """
    r = rotations.astype(np.float64)
    m00, m11, m22 = r[:, 0, 0], r[:, 1, 1], r[:, 2, 2]
    # 4 w^2 - 1, 4 x^2 - 1, 4 y^2 - 1 and 4 z^2 - 1
    squares = np.stack([m00 + m11 + m22, m00 - m11 - m22, m11 - m00 - m22, m22 - m00 - m11], axis=-1)
    largest = np.argmax(squares, axis=-1)
    a, b, c = r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]
    d, e, f = r[:, 1, 0] + r[:, 0, 1], r[:, 0, 2] + r[:, 2, 0], r[:, 2, 1] + r[:, 1, 2]
    s = 1 + squares
    # Row k is the quaternion times 4 times its component k.
    candidates = np.stack(
        [
            np.stack([s[:, 0], a, b, c], axis=-1),
            np.stack([a, s[:, 1], d, e], axis=-1),
            np.stack([b, d, s[:, 2], f], axis=-1),
            np.stack([c, e, f, s[:, 3]], axis=-1),
        ],
        axis=1,
    )
    q = candidates[np.arange(len(r)), largest]
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    q[q[:, 0] < 0] *= -1
    return q.astype(rotations.dtype)


def frames_from_normals(normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Return right-handed frames whose first column is the unit normal; in-plane axes are arbitrary."""
    n = normals.astype(np.float64)
    # The axis nearest to the plane, for a long cross product
    helper = np.eye(3)[np.argmin(np.abs(n), axis=-1)]
    r2 = np.cross(helper, n)
    r2 /= np.linalg.norm(r2, axis=-1, keepdims=True)
    return np.stack([n, r2, np.cross(n, r2)], axis=-1).astype(normals.dtype)
