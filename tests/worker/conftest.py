"""Fixtures of the database, and of workers on one."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from octasplat.workers.postgres.embedded import EmbeddedPostgres
from tests.support.postgres_fixtures import conninfo, copied_database, postgres, short_root, template
from tests.support.worker_harness import WorkerHarness

__all__ = ["bench", "conninfo", "postgres", "short_root", "template"]


@pytest.fixture
def bench(conninfo: str, tmp_path: Path) -> Iterator[WorkerHarness]:
    """Workers on a database of the test's own; they are stopped at its end."""
    bench = WorkerHarness(conninfo, tmp_path)
    yield bench
    bench.close()


@pytest.fixture(scope="module")
def bench_of_module(
    postgres: EmbeddedPostgres, template: str, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[WorkerHarness]:
    """A worker that does all kinds of jobs of the tests."""
    kinds = '["tests.support.toy_kind", "tests.support.hostile_kind", "tests.support.spy_kind"]'
    with copied_database(postgres, template) as copied:
        bench = WorkerHarness(copied, tmp_path_factory.mktemp("shared"))
        bench.worker(KIND_MODULES=kinds)
        yield bench
        bench.close()


@pytest.fixture
def shared_bench(bench_of_module: WorkerHarness) -> Iterator[WorkerHarness]:
    """One running worker of the whole module, for tests that leave it as it is; the gate is shut again."""
    yield bench_of_module
    bench_of_module.gate.unlink(missing_ok=True)
