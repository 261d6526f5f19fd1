"""A later version, in which the same settings give other results."""

from octasplat.engine.core import versions
from tests.support import toy_kind

versions.RESULTS_VERSION += 1

__all__ = ["toy_kind"]
