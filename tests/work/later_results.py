"""A later version, in which the same settings give other results."""

import toy_kind

from octasplat.engine import versions

versions.RESULTS = 2

__all__ = ["toy_kind"]
