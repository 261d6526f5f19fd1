"""Fixtures of the database; all goes on beside the next version, whose tables have further columns."""

import pytest

from tests.support.postgres_fixtures import add_columns, postgres, short_root, template
from tests.support.postgres_fixtures import conninfo as own_conninfo

__all__ = ["conninfo", "own_conninfo", "postgres", "short_root", "template"]


@pytest.fixture(params=[False, True], ids=["own-tables", "later-tables"])
def conninfo(own_conninfo: str, request: pytest.FixtureRequest) -> str:
    """A database of the test's own."""
    if request.param:
        add_columns(own_conninfo)
    return own_conninfo
