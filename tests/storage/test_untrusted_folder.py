"""Files are opened below a folder without following links, whatever its writer has put there."""

import os
from pathlib import Path

import pytest

from octasplat.workers.storage.errors import StorageError, UntrustedFileError
from octasplat.workers.storage.untrusted_folder import UntrustedFolder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "secret").write_text("a secret")
    inside = tmp_path / "inside"
    (inside / "sub").mkdir(parents=True)
    (inside / "sub" / "file").write_text("a file")
    os.link(inside / "sub" / "file", inside / "again")
    (inside / "link").symlink_to("sub/file")
    (inside / "linked").symlink_to(tmp_path / "outside")
    os.link(tmp_path / "outside" / "secret", inside / "hard")
    os.mkfifo(inside / "pipe")
    return inside


def test_own_files_are_opened_by_any_of_their_names(folder: Path) -> None:
    with UntrustedFolder(folder) as opened:
        for name in ("sub/file", "again"):
            with opened.open(name) as handle:
                assert handle.read() == b"a file"
        assert opened.is_file("sub/file") and not opened.is_file("sub")
        assert sorted(opened.names("sub")) == ["file"] and list(opened.names("nothing")) == []
        assert sorted(opened.names()) == ["again", "hard", "link", "linked", "pipe", "sub/file"]


@pytest.mark.parametrize("name", ["link", "linked", "linked/secret", "hard", "pipe", "sub"])
def test_whatever_is_no_file_of_the_folder_alone_is_refused(folder: Path, name: str) -> None:
    with UntrustedFolder(folder) as opened, pytest.raises(UntrustedFileError, match="not a regular file"):
        opened.open(name)


@pytest.mark.parametrize("name", ["../outside/secret", "sub/../again", "/etc/passwd", "", ".", "sub//file"])
def test_names_that_lead_elsewhere_are_refused(folder: Path, name: str) -> None:
    with UntrustedFolder(folder) as opened:
        with pytest.raises(UntrustedFileError):
            opened.open(name)
        assert not opened.is_file(name)


def test_links_are_neither_listed_nor_entered_as_folders(folder: Path, tmp_path: Path) -> None:
    with UntrustedFolder(folder) as opened, pytest.raises(UntrustedFileError, match="not a folder"):
        list(opened.names("linked"))
    (tmp_path / "other").symlink_to(folder)
    with pytest.raises(StorageError):
        UntrustedFolder(tmp_path / "other")
