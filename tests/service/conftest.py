"""Fixtures of the database and of an S3 store."""

from tests.support.postgres_fixtures import conninfo, postgres, short_root, template
from tests.support.s3_server import s3_address, s3_bucket

__all__ = ["conninfo", "postgres", "s3_address", "s3_bucket", "short_root", "template"]
