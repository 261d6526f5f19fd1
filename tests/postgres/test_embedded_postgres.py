"""The private Postgres: started from nothing, taken over, refused where it would do harm."""

import os
import shutil
import signal
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest
from psycopg.conninfo import conninfo_to_dict, make_conninfo

from octasplat.workers.db.errors import DatabaseError
from octasplat.workers.postgres import embedded
from octasplat.workers.postgres.binaries import PostgresBinaries, find_binaries
from octasplat.workers.postgres.embedded import EmbeddedPostgres, sync_file_system
from octasplat.workers.postgres.server_user import server_user
from octasplat.workers.serve.local_service import ServeOptions, connections_needed
from octasplat.workers.settings import WorkerSettings
from tests.support.daily import some_daily


@pytest.fixture
def server(short_root: Path, request: pytest.FixtureRequest) -> Iterator[EmbeddedPostgres]:
    server = EmbeddedPostgres(short_root / f"d{abs(hash(request.node.name)) % 10**8}")
    yield server
    server.stop()


def answer(conninfo: str, query: str) -> str:
    with psycopg.connect(conninfo) as connection:
        row = connection.execute(query.encode()).fetchone()
    assert row is not None
    return str(row[0])


def pid_of(server: EmbeddedPostgres) -> int:
    return int((server.cluster / "postmaster.pid").read_text().split()[0])


def test_postgres_restart_keeps_data(server: EmbeddedPostgres) -> None:
    assert not server.is_running()
    with pytest.raises(DatabaseError, match="octasplat serve"):
        server.conninfo()
    conninfo = server.start()
    with psycopg.connect(conninfo) as connection:
        connection.execute("CREATE TABLE kept AS SELECT 42 AS n")
    assert server.start() == conninfo  # it runs already
    server.stop()
    assert not server.is_running()
    assert answer(server.start(), "SELECT n FROM kept") == "42"
    server.stop()
    server.stop()


def test_postgres_rejects_other_users(server: EmbeddedPostgres) -> None:
    conninfo = server.start()
    assert answer(conninfo, "SHOW listen_addresses") == ""
    folders = (server.cluster, server.home / "run")
    assert [stat.S_IMODE(folder.stat().st_mode) for folder in folders] == [0o700, 0o700]
    assert stat.S_IMODE((server.home / "password").stat().st_mode) == 0o600
    assert answer(conninfo, "SELECT rolpassword FROM pg_authid WHERE rolname = 'octasplat'").startswith(
        "SCRAM"
    )
    with pytest.raises(psycopg.OperationalError, match="password"):
        psycopg.connect(make_conninfo(conninfo, password="wrong"))
    if os.geteuid() == 0:
        assert server.cluster.stat().st_uid == server_user().uid != 0


def test_postgres_stale_pid_file_is_removed(server: EmbeddedPostgres) -> None:
    """Also where the number belongs to another process by now, as after a reboot."""
    server.start()
    with psycopg.connect(server.conninfo()) as connection:
        connection.execute("CREATE TABLE kept AS SELECT 7 AS n")
    os.kill(pid_of(server), signal.SIGKILL)
    pid_file = server.cluster / "postmaster.pid"
    lines = pid_file.read_text().splitlines()
    other = subprocess.Popen(["sleep", "60"], **({"user": server_user().uid} if os.geteuid() == 0 else {}))
    try:
        pid_file.write_text("\n".join([str(other.pid), *lines[1:]]) + "\n")
        assert answer(server.start(), "SELECT n FROM kept") == "7"
    finally:
        other.kill()
        other.wait()


def test_postgres_running_server_is_reused(server: EmbeddedPostgres) -> None:
    code = "from pathlib import Path; " \
           "from octasplat.workers.postgres.embedded import EmbeddedPostgres as E; " \
           f"E(Path({str(server.data)!r})).start()"  # fmt: skip
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])
    before = pid_of(server)
    server.start()
    assert pid_of(server) == before


def test_two_starts_at_once_make_one_database(server: EmbeddedPostgres) -> None:
    code = "from pathlib import Path; " \
           "from octasplat.workers.postgres.embedded import EmbeddedPostgres as E; " \
           f"print(E(Path({str(server.data)!r})).start())"  # fmt: skip
    both = [
        subprocess.Popen(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, cwd=Path(__file__).parents[2], text=True
        )
        for _ in range(2)
    ]
    answers = [process.communicate(timeout=240)[0] for process in both]
    assert answers[0] == answers[1] and answers[0]


def test_long_socket_path_is_replaced(short_root: Path) -> None:
    server = EmbeddedPostgres(short_root / ("long" * 25))
    try:
        conninfo = server.start()
        host = str(conninfo_to_dict(conninfo)["host"])
        assert len(host) < 80 and answer(conninfo, "SELECT 1") == "1"
    finally:
        server.stop()


def test_postgres_other_version_is_refused_without_deletion(server: EmbeddedPostgres) -> None:
    server.start()
    server.stop()
    version = server.cluster / "PG_VERSION"
    version.write_text("11\n")
    before = sorted(path.name for path in server.cluster.iterdir())
    with pytest.raises(DatabaseError, match=r"made by Postgres 11.*pg_dump"):
        server.start()
    assert sorted(path.name for path in server.cluster.iterdir()) == before
    version.write_text("garbage")
    with pytest.raises(DatabaseError, match="backup"):
        server.start()
    version.unlink()
    with pytest.raises(DatabaseError, match="no PG_VERSION"):
        server.start()
    assert (server.cluster / "base").is_dir()
    version.write_text(f"{find_binaries().major}\n")
    assert answer(server.start(), "SELECT 1") == "1"


@pytest.mark.exhaustive
def test_half_made_database_is_made_again(server: EmbeddedPostgres) -> None:
    left = server.home / "cluster.123.partial"
    left.mkdir(parents=True)
    for folder in (server.data, server.home):
        folder.chmod(0o711)
    (left / "half").write_text("")
    assert answer(server.start(), "SELECT 1") == "1"
    assert not left.exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root runs the server as somebody else")
def test_postgres_unreachable_folder_as_root_is_refused(tmp_path: Path) -> None:
    tmp_path.chmod(0o700)
    with pytest.raises(DatabaseError, match=r"cannot pass through.*--data"):
        EmbeddedPostgres(tmp_path / "data").start()


def test_unknown_version_of_binaries_is_named() -> None:
    with pytest.raises(DatabaseError, match="install Postgres 3"):
        find_binaries(3)
    assert find_binaries().major >= 14


@pytest.mark.exhaustive
@pytest.mark.skipif(os.geteuid() != 0, reason="only root runs the server as somebody else")
def test_binaries_out_of_the_servers_reach_are_copied(
    short_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where root has its virtual environment in its home."""
    install = find_binaries().folder.parent
    private = tmp_path / "site-packages"
    for folder in (install, install.parent.with_name(f"{install.parent.name}.libs")):
        if folder.is_dir():
            shutil.copytree(folder, private / folder.relative_to(install.parents[1]), symlinks=True)
    private.chmod(0o700)
    moved = PostgresBinaries(private / install.relative_to(install.parents[1]) / "bin", find_binaries().major)
    monkeypatch.setattr("octasplat.workers.postgres.embedded.find_binaries", lambda _major=None: moved)
    server = EmbeddedPostgres(short_root / "copied")
    try:
        assert answer(server.start(), "SELECT 1") == "1"
        assert any(path.name.startswith("binaries-") for path in server.home.iterdir())
    finally:
        server.stop()


def test_postgres_new_cluster_is_synced_before_rename(
    server: EmbeddedPostgres, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced = []

    def sync(folder: Path) -> bool:
        synced.append((folder.name, server.cluster.exists()))
        return sync_file_system(folder)

    monkeypatch.setattr(embedded, "sync_file_system", sync)
    server.start()
    (first, there), *_ = synced
    assert first.endswith(".partial") and not there


def test_database_log_is_bounded(server: EmbeddedPostgres, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(embedded, "MAX_LOG_BYTES", 20_000)
    conninfo = server.start()
    log = server.home / "log"
    with psycopg.connect(conninfo, autocommit=True) as connection:
        for number in range(400):
            with pytest.raises(psycopg.errors.UndefinedTable):
                connection.execute(f"SELECT 1 FROM missing_{number}".encode())
    server.rotate_log()
    assert log.stat().st_size < 20_000 and "missing_399" in (server.home / "log.1").read_text()
    assert stat.S_IMODE((server.home / "log.1").stat().st_mode) == 0o600
    assert answer(conninfo, "SELECT 1") == "1"
    with psycopg.connect(conninfo) as connection, pytest.raises(psycopg.errors.UndefinedTable):
        connection.execute("SELECT 1 FROM later")
    assert log.read_bytes().lstrip(b"\0") == log.read_bytes() and "later" in log.read_text()


def test_connections_grow_with_the_jobs_at_once(short_root: Path) -> None:
    def plan(**queues: int) -> ServeOptions:
        return ServeOptions(WorkerSettings(data=short_root / "many"), None, None, queues)

    assert connections_needed(plan(cpu=1)) == 100
    needed = connections_needed(plan(cpu=60))
    assert needed > 12 + 6 + 4 * 60
    server = EmbeddedPostgres(short_root / "many", needed)
    try:
        assert answer(server.start(), "SHOW max_connections") == str(needed)
    finally:
        server.stop()


@pytest.mark.parametrize("name", some_daily(["a,b", "it's", 'say "$HOME" `x`', "with space"], ["it's"]))
def test_data_folder_may_have_any_name(short_root: Path, name: str) -> None:
    server = EmbeddedPostgres(short_root / f"{name} {os.getpid()}")
    try:
        assert answer(server.start(), "SELECT 42") == "42"
        assert (server.home / "log").stat().st_size > 0
    finally:
        server.stop()
    assert not server.is_running()


def test_postgres_socket_is_independent_of_environment(
    short_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = EmbeddedPostgres(short_root / ("l" * 90))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    conninfo = server.start()
    try:
        monkeypatch.delenv("XDG_RUNTIME_DIR")
        assert server.conninfo() == conninfo and server.is_running()
        assert server.start() == conninfo
    finally:
        server.stop()


def test_postgres_server_of_earlier_version_is_reused(
    short_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It put its socket where the environment said."""
    elsewhere = short_root / "runtime"
    elsewhere.mkdir(mode=0o711)
    server = EmbeddedPostgres(short_root / "earlier")
    with monkeypatch.context() as patched:
        patched.setattr(EmbeddedPostgres, "_socket_folder", lambda _self: elsewhere / "octasplat-x")
        server.start()
    try:
        assert server.is_running() and str(elsewhere) in server.conninfo()
    finally:
        server.stop()
