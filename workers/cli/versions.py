"""The versions that results and speed depend on, as ``octasplat --version`` prints them."""

import platform
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from octasplat.engine import __version__
from octasplat.engine.core.versions import RESULTS_VERSION

_PACKAGES = ("torch", "numba", "llvmlite", "numpy", "pycolmap", "embreex")
_FEATURES = ("avx", "fma", "avx2", "avx512f", "asimd", "sve")
"""Features of processors that decide which machine code kernels and Embree get."""


def version_lines() -> Iterator[str]:
    """Yield the versions, one a line; nothing heavy is imported for them."""
    yield f"octasplat, version {__version__}"
    yield f"results version {RESULTS_VERSION}"
    yield f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"
    for name in _PACKAGES:
        try:
            yield f"{name} {version(name)}"
        except PackageNotFoundError:
            yield f"{name} is not installed"
    if features := cpu_features():
        yield f"CPU features: {' '.join(features)}"


def cpu_features(cpuinfo: Path = Path("/proc/cpuinfo")) -> tuple[str, ...]:
    """Return what the processor has of the features that matter; none where the system does not tell."""
    try:
        lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return ()
    # "flags" on x86-64 and "Features" on ARM.
    flags = next((line.partition(":")[2] for line in lines if line.startswith(("flags", "Features"))), "")
    known = set(flags.split())
    return tuple(feature for feature in _FEATURES if feature in known)
