from collections.abc import Iterator
from pathlib import Path

import pytest

from octasplat.workers.storage import Storage
from octasplat.workers.storage.local import LocalStorage
from octasplat.workers.storage.s3 import S3Storage
from tests.support.s3_server import s3_address, s3_bucket

__all__ = ["s3_address", "s3_bucket"]


@pytest.fixture
def s3_storage(s3_address: str, s3_bucket: str) -> Iterator[S3Storage]:
    storage = S3Storage(s3_bucket, "some/prefix/", endpoint_url=s3_address)
    yield storage
    storage.close()


@pytest.fixture
def local_storage(tmp_path: Path) -> Iterator[LocalStorage]:
    storage = LocalStorage(tmp_path / "store", floor_bytes=0)
    yield storage
    storage.close()


@pytest.fixture(params=["local", "s3"])
def storage(request: pytest.FixtureRequest) -> Storage:
    """Each kind of store in turn; every test that takes it belongs to the contract."""
    found: Storage = request.getfixturevalue(f"{request.param}_storage")
    return found
