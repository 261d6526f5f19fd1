"""The folder of a store is the same for those who open it and for those who keep jobs out of it."""

from pathlib import Path

import pytest

from octasplat.workers.settings import WorkerSettings
from octasplat.workers.storage.factory import open_storage
from octasplat.workers.storage.local import LocalStorage


@pytest.mark.parametrize("address", ["{}/store", "{}/a#b", "{}/a?b", "a:b", "file://{}/store"])
def test_folder_of_store_is_one_of_the_own_folders(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    settings = WorkerSettings(data=tmp_path / "data", storage=address.format(tmp_path))
    storage = open_storage(settings.storage_address)
    assert isinstance(storage, LocalStorage) and storage.root in settings.own_folders
    storage.close()


def test_bucket_is_no_folder(tmp_path: Path) -> None:
    settings = WorkerSettings(data=tmp_path, storage="s3://bucket/prefix")
    assert settings.own_folders == (tmp_path, tmp_path / "work")
