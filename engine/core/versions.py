"""Versions of everything that can change a result, written to ``config.json`` and ``metrics.json``."""

import importlib.metadata
from collections.abc import Mapping
from functools import cache

from octasplat.engine import __version__

PACKAGES = (
    "embreex",  # Embree: which rays meet which boxes
    "fast-simplification",  # fewer triangles for surfaces
    "laspy",  # reads laser scans
    "llvmlite",  # compiles the kernels
    "numba",
    "numpy",
    "OpenImageIO",  # decodes photographs
    "pillow",  # reads the tags that tell what their values mean
    "pycolmap",  # undistorts rays
    "scipy",
    "torch",  # shrinks photographs
    "xatlas",  # cuts surfaces open for textures
    "zstandard",  # packs some exports
)


RESULTS_VERSION = 12
"""Raised whenever the same settings give other results than before: what was begun under one number is begun
anew under another, rather than gone on with."""


UNSTATED_RESULTS = 11
"""Results version of what is between steps and does not state its own: of versions before this was stated.
From 5 to 11 it was raised for other things than what is kept between the steps of a training."""
STATED = "results"
"""Where records state the results version of what they are of."""


def has_same_results(record: Mapping[str, object]) -> bool:
    """Return whether a record is of a version that has the results of this one for the same settings."""
    return record.get(STATED, UNSTATED_RESULTS) == RESULTS_VERSION


def package_versions() -> dict[str, str]:
    """Return the versions of the project and of the packages that it computes with, by name."""
    return {"octasplat": __version__, **{name: _installed_version(name) for name in PACKAGES}}


_installed_version = cache(importlib.metadata.version)  # which parses the package's files each time
