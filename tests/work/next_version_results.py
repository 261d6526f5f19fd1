"""A later version, in which the same settings give other results."""

import toy_kind

from octasplat.engine import versions

versions.RESULTS += 1

__all__ = ["toy_kind"]
