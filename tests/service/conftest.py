"""Fixtures of the database, of an S3 store, and of a service within the test's own process."""

from functools import partial
from pathlib import Path

import pytest

from tests.support.postgres_fixtures import conninfo, postgres, short_root, template
from tests.support.s3_server import s3_address, s3_bucket
from tests.support.service_harness import ConnectService, running_service

__all__ = ["conninfo", "postgres", "s3_address", "s3_bucket", "short_root", "template"]


@pytest.fixture
def connect_service(conninfo: str, tmp_path: Path) -> ConnectService:
    """A service in this process for as long as ``async with`` lasts, with a client of it."""
    return partial(running_service, conninfo, tmp_path)
