"""Fixtures of the database; the toy kind of the workers' tests is known here too."""

import sys
from pathlib import Path

from postgres_fixtures import conninfo, postgres, short_root, template
from s3_server import s3_address, s3_bucket

sys.path.append(str(Path(__file__).parents[1] / "work"))

__all__ = ["conninfo", "postgres", "s3_address", "s3_bucket", "short_root", "template"]
