"""Files are opened below a folder without following links, whatever its writer has put there."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from octasplat.workers.sandbox.linux import IS_LINUX
from octasplat.workers.storage.errors import StorageError, UntrustedFileError
from octasplat.workers.storage.folder_removal import remove_folder
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


def make_deep(folder: Path, levels: int) -> None:
    """Make folders in each other, with a file in the last, whose whole name no call would take."""
    folder.mkdir()
    inner = os.open(folder, os.O_RDONLY)
    for _ in range(levels):
        os.mkdir("d", dir_fd=inner)
        outer, inner = inner, os.open("d", os.O_RDONLY, dir_fd=inner)
        os.close(outer)
    os.close(os.open("file", os.O_CREAT | os.O_WRONLY, dir_fd=inner))
    os.close(inner)


def test_folders_too_deep_are_refused_and_can_be_removed(tmp_path: Path) -> None:
    make_deep(tmp_path / "deep", 1500)
    with UntrustedFolder(tmp_path / "deep") as opened:
        with pytest.raises(UntrustedFileError, match="folders in each other"):
            list(opened.names())
        with pytest.raises(UntrustedFileError, match="folders in each other"):
            opened.disk_usage_bytes(leave_out="")
    remove_folder(tmp_path / "deep")
    assert list(tmp_path.iterdir()) == []


def test_removal_follows_no_links(folder: Path) -> None:
    remove_folder(folder)
    assert not folder.exists() and (folder.with_name("outside") / "secret").read_text() == "a secret"


SHUT = """
import os, sys
from pathlib import Path
from octasplat.workers.storage.errors import UntrustedFileError
from octasplat.workers.storage.folder_removal import remove_folder
from octasplat.workers.storage.untrusted_folder import UntrustedFolder

folder = Path(sys.argv[1])
if os.geteuid() == 0:
    os.chown(folder, 65534, 65534)
    os.setresuid(65534, 65534, 65534)
for mode in (0o000, 0o300, 0o500):
    shut = folder / "work" / f"{mode:o}"
    shut.mkdir(parents=True)
    (shut / "file").write_text("x" * 5000)
    shut.chmod(mode)
with UntrustedFolder(folder / "work") as opened:
    for look in (lambda: list(opened.names()), lambda: opened.disk_usage_bytes(leave_out="")):
        try:
            look()
        except UntrustedFileError:
            print("refused")
remove_folder(folder / "work")
print(*folder.iterdir())
"""


@pytest.mark.skipif(not IS_LINUX, reason="folders are opened without access on Linux only")
def test_folders_shut_to_their_owner_are_refused_and_can_be_removed() -> None:
    # Not a folder of the tests', which only their user passes to.
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-c", SHUT, folder], capture_output=True, text=True, check=True
        )
    assert done.stdout.split() == ["refused", "refused"]
