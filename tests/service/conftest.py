"""Fixtures of the database; the toy kind of the workers' tests is known here too."""

import sys
from pathlib import Path

from bucket_for_tests import s3_address, s3_bucket
from postgres_for_tests import conninfo, postgres, short_root, template

sys.path.append(str(Path(__file__).parents[1] / "work"))

__all__ = ["conninfo", "postgres", "s3_address", "s3_bucket", "short_root", "template"]
