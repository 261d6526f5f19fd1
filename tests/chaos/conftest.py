"""Fixtures of the database."""

from tests.support.postgres_fixtures import conninfo, postgres, short_root, template

__all__ = ["conninfo", "postgres", "short_root", "template"]
