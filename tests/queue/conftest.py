"""Fixtures of the database; all goes on beside the next version, whose tables have further columns."""

from tests.support.postgres_fixtures import conninfo as conninfo_of_own_version
from tests.support.postgres_fixtures import conninfo_of_both_versions as conninfo
from tests.support.postgres_fixtures import postgres, short_root, template

__all__ = ["conninfo", "conninfo_of_own_version", "postgres", "short_root", "template"]
