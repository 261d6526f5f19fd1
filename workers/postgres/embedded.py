"""A private Postgres in the data folder, reached by a socket only, for those who have none.

    postgres/cluster/    the data; never deleted, not even when they cannot be used
    postgres/run/        the socket
    postgres/password    of the only user, readable by its owner
    postgres/log         what the server says, and before that in log.1

The server outlives a killed parent; the next start finds it running and takes it over.
"""

import contextlib
import ctypes
import fcntl
import hashlib
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil
import psycopg
from psycopg.conninfo import make_conninfo

from octasplat.workers.db.errors import DatabaseError
from octasplat.workers.postgres.binaries import PostgresBinaries, find_binaries
from octasplat.workers.postgres.server_user import (
    ServerUser,
    check_reachable,
    reachable_binaries,
    server_user,
)

DATABASE_NAME = "octasplat"
"""Name of the database and of its user."""
SOCKET_PORT = 5432
"""Only names the socket; nothing listens on it."""
START_SECONDS = 60
MIN_CONNECTIONS = 100
MAX_LOG_BYTES = 16 << 20
"""The log begins anew when it is longer; the one before stays beside it."""
_MAX_SOCKET_BYTES = 103  # the shortest limit there is (macOS); Linux takes 107
_SETTINGS = (
    "listen_addresses=",
    "unix_socket_permissions=0700",
    "shared_buffers=32MB",
    "password_encryption=scram-sha-256",
    "timezone=UTC",
    "log_timezone=UTC",
)


@dataclass(frozen=True)
class EmbeddedPostgres:
    """The private Postgres of one data folder.

    Args:
        data: the data folder of the service.
        connections: how many there may be at once; of a server that runs already they stay as they are.
    """

    data: Path
    connections: int = MIN_CONNECTIONS

    @property
    def home(self) -> Path:
        """The folder of everything that belongs to the database."""
        return self.data / "postgres"

    @property
    def cluster(self) -> Path:
        """The folder of the data themselves."""
        return self.home / "cluster"

    def conninfo(self) -> str:
        """Return how to connect; the password is part of it.

        Raises:
            DatabaseError: the database was never started here.
        """
        try:
            password = (self.home / "password").read_text(encoding="ascii").strip()
        except OSError as error:
            raise DatabaseError(
                f"{self.home} holds no database of yours ({error.strerror}); start one with octasplat serve "
                "--data, or set DATABASE_URL."
            ) from None
        return make_conninfo(
            host=str(self._socket_folder()),
            port=SOCKET_PORT,
            user=DATABASE_NAME,
            dbname=DATABASE_NAME,
            password=password,
        )

    def is_running(self) -> bool:
        """Return whether the server answers."""
        try:
            with psycopg.connect(self.conninfo(), connect_timeout=5):
                return True
        except (DatabaseError, psycopg.OperationalError):
            return False

    def start(self) -> str:
        """Start the server unless it runs, making the database first if there is none.

        Returns:
            How to connect, see :meth:`conninfo`.

        Raises:
            DatabaseError: it cannot be started; the text says what to do.
        """
        user = server_user()
        self._make_home(user)
        with self._folder_lock():
            if not self.is_running():
                binaries = self._find_binaries(user)
                if not (self.cluster / "PG_VERSION").exists():
                    self._create_cluster(binaries, user)
                self._remove_stale_locks()
                self._start_server(binaries, user)
            self._create_database()
        return self.conninfo()

    def stop(self) -> None:
        """Stop the server, undoing transactions under way; harmless if it is down."""
        if not (self.cluster / "postmaster.pid").exists():
            return
        user = server_user()
        with self._folder_lock():
            self._run_program(
                self._find_binaries(user), user, "pg_ctl", "-D", ".", "-m", "fast", "-w", "stop", check=False
            )

    def _make_home(self, user: ServerUser) -> None:
        # Root keeps its own folders below to itself; the server's user only needs to pass through.
        mode = 0o711 if user.switches else 0o700
        try:
            for folder in (self.data, self.home):
                if not folder.exists():
                    folder.mkdir(parents=True)
                    folder.chmod(mode)
            check_reachable(self.home / "cluster", user)
            (self.home / "run").mkdir(exist_ok=True)
            for folder in (self.home / "run", self._socket_folder()):
                folder.mkdir(exist_ok=True, mode=0o700)
                # Everybody may write to /tmp, and make this folder there before us.
                facts = folder.lstat()
                if folder.is_symlink() or facts.st_uid not in (os.geteuid(), user.uid):
                    raise DatabaseError(f"{folder} belongs to somebody else; remove it and start again.")
                user.chown(folder)
                folder.chmod(0o700)
            log = self.home / "log"
            log.touch(mode=0o600)
            user.chown(log)
        except OSError as error:
            raise DatabaseError(
                f"{self.home} cannot be used ({error.strerror or error}); name another data folder."
            ) from None

    def _socket_folder(self) -> Path:
        """Return the socket's folder: that of the running server, else always the same."""
        folder = (self.home / "run").resolve()
        if (running := self._running_socket_folder()) is not None:
            return running
        socket = f"{folder}/.s.PGSQL.{SOCKET_PORT}"
        # A comma separates hosts in what clients are given, and folders in the server's settings.
        if len(os.fsencode(socket)) <= _MAX_SOCKET_BYTES and "," not in socket:
            return folder
        digest = hashlib.sha256(os.fsencode(folder)).hexdigest()[:16]
        # Not in a folder of the environment's choice, which is another for cron and sudo.
        return Path("/tmp") / f"octasplat-{digest}"  # noqa: S108

    def _running_socket_folder(self) -> Path | None:
        """Return the folder that a server which runs has written down beside its number."""
        pid_file = self.cluster / "postmaster.pid"
        try:
            # The fifth line of postmaster.pid is the folder of its socket.
            line = pid_file.read_text(encoding="utf-8", errors="surrogateescape").split("\n")[4]
        except (OSError, IndexError):
            return None
        return (self.cluster / line).resolve() if line and is_postgres_running(pid_file) else None

    def _find_binaries(self, user: ServerUser) -> PostgresBinaries:
        version = self.cluster / "PG_VERSION"
        try:
            major = int(version.read_text(encoding="ascii")) if version.exists() else None
        except (OSError, ValueError):
            raise DatabaseError(
                f"{version} cannot be read, so the database is damaged; restore {self.cluster} from a "
                "backup. Nothing was changed."
            ) from None
        return reachable_binaries(find_binaries(major), user, self.home)

    def _create_cluster(self, binaries: PostgresBinaries, user: ServerUser) -> None:
        """Make the cluster beside its place and rename it, so that a kill leaves no half of one."""
        if self.cluster.exists() and any(self.cluster.iterdir()):
            raise DatabaseError(
                f"{self.cluster} holds files but no PG_VERSION, so it is no database that can be started; "
                "move it away or restore it. Nothing was changed."
            )
        for left in self.home.glob("cluster.*.partial"):  # of starts that were killed
            shutil.rmtree(left)
        partial = self.home / f"cluster.{os.getpid()}.partial"
        partial.mkdir(mode=0o700)
        user.chown(partial)
        password = secrets.token_urlsafe(32)
        with tempfile.NamedTemporaryFile("w", dir=self.home, prefix=".password.", delete=False) as handle:
            handle.write(password)
        given = Path(handle.name)
        try:
            user.chown(given)
            self._run_program(
                binaries, user, "initdb", "-D", ".", "-U", DATABASE_NAME, f"--pwfile={given}",
                "--auth=scram-sha-256", "--encoding=UTF8", "--locale=C", "--no-sync", cwd=partial,
            )  # fmt: skip
            if user.switches:
                os.chown(given, os.geteuid(), os.getegid())
            given.chmod(0o600)
            given.replace(self.home / "password")
        finally:
            given.unlink(missing_ok=True)
        if self.cluster.exists():
            self.cluster.rmdir()
        # Before it takes its place, so that no power cut leaves half of one there; all at once, as a thousand
        # flushes of single files take seconds on some disks.
        if not sync_file_system(partial):
            self._run_program(binaries, user, "initdb", "--sync-only", "-D", ".", cwd=partial)
        partial.rename(self.cluster)
        sync_file_system(self.home)

    def rotate_log(self) -> None:
        """Begin the log anew if it is long."""
        log = self.home / "log"
        with contextlib.suppress(OSError):
            if log.stat().st_size <= MAX_LOG_BYTES:
                return
            partial = self.home / "log.1.partial"
            with log.open("rb") as source, partial.open("wb") as target:
                source.seek(-MAX_LOG_BYTES, os.SEEK_END)
                shutil.copyfileobj(source, target)
            partial.chmod(0o600)
            partial.replace(self.home / "log.1")
            os.truncate(log, 0)  # the server appends to it

    def _remove_stale_locks(self) -> None:
        """Remove lock files of a server that is gone and that would keep Postgres from starting.

        Their PID may belong to another program by now, or to a zombie process that nothing reaps, as in
        containers without an init process.
        """
        for path in (
            self.cluster / "postmaster.pid",
            self._socket_folder() / f".s.PGSQL.{SOCKET_PORT}.lock",
        ):
            if path.exists() and not is_postgres_running(path):
                path.unlink(missing_ok=True)

    def _start_server(self, binaries: PostgresBinaries, user: ServerUser) -> None:
        self.rotate_log()
        # A shell reads the options and the name of the log, so that both are relative: to the cluster, where
        # the server works. The data folder may have any name.
        sockets = self._socket_folder()
        if sockets.parent == self.home.resolve():
            sockets = Path("../run")
        options = [
            f"unix_socket_directories={sockets}",
            f"max_connections={self.connections}",
            *_SETTINGS,
        ]
        quoted = " ".join(f"-c '{option}'" for option in options)
        try:
            self._run_program(
                binaries, user, "pg_ctl", "-D", ".", "-w", "-t", str(START_SECONDS),
                "-l", "../log", "-o", quoted, "start",
            )  # fmt: skip
        except DatabaseError:
            raise DatabaseError(
                f"The database in {self.home} does not start: {self._last_log_error()} "
                f"(more in {self.home / 'log'})"
            ) from None

    def _create_database(self) -> None:
        conninfo = make_conninfo(self.conninfo(), dbname="postgres")
        with psycopg.connect(conninfo, autocommit=True) as connection:
            query = "SELECT 1 FROM pg_database WHERE datname = %s"
            if connection.execute(query, [DATABASE_NAME]).fetchone() is None:
                connection.execute("CREATE DATABASE octasplat")

    def _last_log_error(self) -> str:
        lines = (self.home / "log").read_text(encoding="utf-8", errors="replace").splitlines()
        fatal = [line for line in lines[-20:] if "FATAL" in line or "PANIC" in line] or lines[-1:]
        return fatal[-1] if fatal else "it says nothing."

    def _run_program(
        self,
        binaries: PostgresBinaries,
        user: ServerUser,
        program: str,
        *arguments: str,
        cwd: Path | None = None,
        check: bool = True,
    ) -> None:
        command: Sequence[str] = (binaries.program(program), *arguments)
        identity = (
            {"user": user.uid, "group": user.gid, "extra_groups": [], "umask": 0o077} if user.switches else {}
        )
        # Not through a pipe: the server inherits it and would keep it open.
        with tempfile.TemporaryFile() as output:
            try:
                done = subprocess.run(  # noqa: S603
                    command,
                    cwd=cwd or self.cluster,
                    env={"PATH": os.environ.get("PATH", ""), "LC_ALL": "C", "TZ": "UTC"},
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    # A Ctrl+C in the terminal does not reach the server, which is stopped after its clients.
                    start_new_session=True,
                    timeout=START_SECONDS + 30,
                    check=False,
                    **identity,  # type: ignore[call-overload]
                )
            except (OSError, subprocess.SubprocessError) as error:
                raise DatabaseError(f"{command[0]} cannot be run ({error}).") from None
            output.seek(0)
            text = " ".join(output.read().decode(errors="replace").split())
        if check and done.returncode != 0:
            raise DatabaseError(f"{program} failed: {text[-600:]}")

    def is_alive(self) -> bool:
        """Return whether the server's process lives; cheaper than asking it, as :meth:`is_running` does."""
        return is_postgres_running(self.cluster / "postmaster.pid")

    @contextlib.contextmanager
    def _folder_lock(self) -> Iterator[None]:
        """Hold the lock of this folder, so that two starts at once make one database."""
        with (self.home / "lock").open("w") as handle:
            fcntl.flock(handle, fcntl.LOCK_EX)
            yield


def sync_file_system(folder: Path) -> bool:
    """Flush the disk that a folder is on; False where the system has no way to."""
    if not sys.platform.startswith("linux"):
        return False
    fd = os.open(folder, os.O_RDONLY)
    try:
        return bool(ctypes.CDLL(None, use_errno=True).syncfs(fd) == 0)
    except AttributeError:
        return False
    finally:
        os.close(fd)


def is_postgres_running(pid_file: Path) -> bool:
    """Return whether the number in a pid file is that of a living Postgres."""
    try:
        process = psutil.Process(int(pid_file.read_text(encoding="utf-8").split("\n", 1)[0]))
        return process.status() != psutil.STATUS_ZOMBIE and "postgres" in process.name()
    except (OSError, ValueError, psutil.Error):
        return False
