"""Fixtures of the database, and of workers on one."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.postgres_fixtures import conninfo, postgres, short_root, template
from tests.support.worker_harness import WorkerHarness

__all__ = ["bench", "conninfo", "postgres", "short_root", "template"]


@pytest.fixture
def bench(conninfo: str, tmp_path: Path) -> Iterator[WorkerHarness]:
    """Workers on a database of the test's own; they are stopped at its end."""
    bench = WorkerHarness(conninfo, tmp_path)
    yield bench
    bench.close()
