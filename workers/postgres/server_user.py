"""As whom the private Postgres runs: Postgres refuses root, so root starts it as somebody else."""

import os
import pwd
import shutil
from dataclasses import dataclass
from pathlib import Path

from octasplat.workers.db.errors import DatabaseError
from octasplat.workers.postgres.binaries import PostgresBinaries

_CANDIDATES = ("octasplat", "postgres", "nobody")


@dataclass(frozen=True)
class ServerUser:
    """The user of the server's processes and files.

    Attributes:
        uid: user id.
        gid: group id.
        switches: whether this process is root and has to become that user for the server.
    """

    uid: int
    gid: int
    switches: bool

    def chown(self, path: Path) -> None:
        """Give ``path`` to the user."""
        if self.switches:
            os.chown(path, self.uid, self.gid)


def server_user() -> ServerUser:
    """Return this user, or for root the first that exists of octasplat, postgres and nobody.

    Raises:
        DatabaseError: the user id has no name, which Postgres insists on.
    """
    uid = os.geteuid()
    if uid != 0:
        try:
            entry = pwd.getpwuid(uid)
        except KeyError:
            raise DatabaseError(
                f"The user id {uid} has no entry in the user database, without which Postgres does not "
                "start; add one, or set DATABASE_URL to a running Postgres."
            ) from None
        return ServerUser(uid, entry.pw_gid, False)
    for name in _CANDIDATES:
        try:
            entry = pwd.getpwnam(name)
        except KeyError:
            continue
        return ServerUser(entry.pw_uid, entry.pw_gid, True)
    raise DatabaseError(
        "Postgres does not run as root and there is no user called octasplat, postgres or nobody to "
        "run it as; add one, or set DATABASE_URL to a running Postgres."
    )


def check_reachable(folder: Path, user: ServerUser) -> None:
    """Make sure that the server's user can get to ``folder``.

    Raises:
        DatabaseError: a folder above shuts it out.
    """
    if not user.switches:
        return
    for above in reversed(folder.resolve().parents):
        if above.exists() and not _can_traverse(above, user):
            raise DatabaseError(
                f"As root the database runs as user {pwd.getpwuid(user.uid).pw_name}, who cannot pass "
                f"through {above}; name a data folder elsewhere (--data), start as another user, or set "
                "DATABASE_URL."
            )


def reachable_binaries(binaries: PostgresBinaries, user: ServerUser, copy_folder: Path) -> PostgresBinaries:
    """Return binaries that ``user`` may run: a copy in ``copy_folder`` if it cannot reach the originals."""
    above = (binaries.folder, *binaries.folder.parents)
    if not user.switches or all(_can_traverse(folder, user) for folder in above):
        return binaries
    install = binaries.folder.parent
    copy = copy_folder / f"binaries-{binaries.major}"
    if not copy.exists():
        partial = copy_folder / f"binaries-{binaries.major}.{os.getpid()}.partial"
        shutil.rmtree(partial, ignore_errors=True)
        shutil.copytree(install, partial / install.parent.name / install.name, symlinks=True)
        # A wheel keeps its libraries beside its package, where the programs look for them.
        libraries = install.parent.with_name(f"{install.parent.name}.libs")
        if libraries.is_dir():
            shutil.copytree(libraries, partial / libraries.name, symlinks=True)
        for folder in (partial, partial / install.parent.name):
            folder.chmod(0o755)
        partial.rename(copy)
    return PostgresBinaries(copy / install.parent.name / install.name / "bin", binaries.major)


def _can_traverse(folder: Path, user: ServerUser) -> bool:
    facts = folder.stat()
    if facts.st_uid == user.uid:
        return bool(facts.st_mode & 0o100)
    if facts.st_gid == user.gid:
        return bool(facts.st_mode & 0o010)
    return bool(facts.st_mode & 0o001)
