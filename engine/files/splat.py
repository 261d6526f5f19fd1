""".splat: 32 bytes a Gaussian without a header; colour and opacity are bytes, harmonics are missing."""

from pathlib import Path

import numpy as np

from engine.errors import SceneFileError
from engine.files.encodings import logits_from_bytes, sh0_from_rgb
from engine.files.importing import Importer, register
from engine.gaussians.flattening import GaussianCloud

SPLAT = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat_wxyz", "u1", 4)])


def read(path: Path) -> GaussianCloud:
    """Read all Gaussians; scales are standard deviations, rotations are 128 + 128 q.

    Raises:
        SceneFileError: the size is not a multiple of 32 bytes, or the file cannot be read.
    """
    try:
        size = path.stat().st_size
        if size % SPLAT.itemsize:
            raise SceneFileError(
                f"{path}: is no .splat, or is truncated; its {size} bytes are not a multiple of 32."
            )
        rows = np.fromfile(path, dtype=SPLAT)
    except OSError as error:
        raise SceneFileError(f"{path}: cannot be read ({error.strerror or error}).") from error
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(rows["scale"])
    return GaussianCloud(
        means_world=rows["mean"].astype(np.float32),
        quats_wxyz=((rows["quat_wxyz"].astype(np.float32) - 128.0) / 128.0).astype(np.float32),
        log_scales=log_scales.astype(np.float32),
        opacity_logits=logits_from_bytes(rows["rgba"][:, 3]),
        sh=sh0_from_rgb(rows["rgba"][:, :3] / 255.0),
    )


register(Importer("splat", ("*.splat",), "32 bytes a Gaussian (antimatter15)", read))
