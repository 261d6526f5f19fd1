"""Fixtures of the database; the helpers of the workers' tests are known here too."""

import sys
from pathlib import Path

from postgres_fixtures import conninfo, postgres, short_root, template

sys.path.append(str(Path(__file__).parents[1] / "work"))

__all__ = ["conninfo", "postgres", "short_root", "template"]
