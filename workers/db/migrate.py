"""Migration of a database to this version's tables: ours and the queue's, each step once, under one lock.

Steps only add, so that processes of the former version can continue beside this one's: they begin, end and
write only what they know. A step that they can no longer read or write raises :data:`OLDEST_READER`.
"""

import logging
import time
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from importlib import resources
from importlib.resources.abc import Traversable

import psycopg

from octasplat.workers.db.errors import DatabaseError

OWN_COMPONENT, QUEUE_COMPONENT = "octasplat", "procrastinate"
MIN_SERVER_VERSION = 140000
OLDEST_READER = "0007_files.sql"
"""Processes that know this step of ours may go on with the tables of this version."""
MAX_WAIT_SECONDS = 120.0
LOCK_TIMEOUT_SECONDS = 2.0
"""For so long a step waits for a table at a time, and then leaves it to others as long."""
_POLL_SECONDS = 0.2
_LOCK = 0x6F637461  # "octa"
_SCHEMA_TABLES = """
CREATE TABLE IF NOT EXISTS schema_steps (
    component text NOT NULL,
    name text NOT NULL,
    applied_at timestamptz NOT NULL DEFAULT now(),
    PRIMARY KEY (component, name)
);
CREATE TABLE IF NOT EXISTS schema_reach (
    one boolean PRIMARY KEY DEFAULT true CHECK (one),
    oldest_reader text NOT NULL
);
"""

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Migration:
    """One file of SQL that is applied once.

    Attributes:
        component: whose tables it changes.
        name: name of the file; the files of a component are applied in the order of their names.
        sql: what is executed.
    """

    component: str
    name: str
    sql: str


def migrate(conninfo: str, only: Collection[str] | None = None) -> tuple[str, ...]:
    """Apply every step that the database lacks; others who start meanwhile wait.

    Args:
        conninfo: how to connect.
        only: names to which the steps of octasplat itself are restricted; those of Procrastinate are applied
            in any case.

    Returns:
        Names of the steps applied; empty where a newer, compatible version has migrated already.

    Raises:
        DatabaseError: the database cannot be reached, is too old, or is too new for this version.
    """
    try:
        with psycopg.connect(conninfo, autocommit=True, connect_timeout=10) as connection:
            if connection.info.server_version < MIN_SERVER_VERSION:
                major = connection.info.server_version // 10000
                raise DatabaseError(f"The database is Postgres {major}; Postgres 14 or newer is needed.")
            _acquire_lock(connection)
            return tuple(_apply_missing(connection, only))
    except psycopg.OperationalError as error:
        raise _unreachable_error(error) from None
    except psycopg.Error as error:
        raise DatabaseError(
            f"The database's tables cannot be brought up to date: {_one_line(error)}"
        ) from None


def _acquire_lock(connection: psycopg.Connection) -> None:
    """Take the lock under which tables are changed; it ends with the connection.

    Raises:
        DatabaseError: somebody else has it for too long.
    """
    deadline = time.monotonic() + MAX_WAIT_SECONDS
    # Polled, as pg_advisory_lock would wait without an end.
    while connection.execute("SELECT pg_try_advisory_lock(%s)", [_LOCK]).fetchone() != (True,):
        if time.monotonic() > deadline:
            raise DatabaseError(
                f"Another process has changed the tables for {MAX_WAIT_SECONDS:g} s; wait for it, or end it."
            )
        time.sleep(_POLL_SECONDS)


def apply_step(connection: psycopg.Connection, step: Migration) -> None:
    """Apply a step, requesting its locks again and again for a short time each.

    A transaction that waits for the lock of a table blocks all that come after it, so no wait is longer than
    a running service can bear.

    Raises:
        DatabaseError: somebody holds a table for too long.
    """
    deadline = time.monotonic() + MAX_WAIT_SECONDS
    while True:
        try:
            # In one transaction, so that exactly the steps that are applied are recorded.
            with connection.transaction():
                connection.execute(
                    "SELECT set_config('lock_timeout', %s, true)", [f"{LOCK_TIMEOUT_SECONDS:g}s"]
                )
                connection.execute(step.sql)
                _record_migration(connection, step)
            return
        except (psycopg.errors.LockNotAvailable, psycopg.errors.DeadlockDetected) as error:
            if time.monotonic() > deadline:
                raise DatabaseError(
                    f"The tables are in use, so that the step {step.name} cannot be applied "
                    f"({_one_line(error)}); end what holds them, such as a backup, and start again."
                ) from None
            logger.info("the step %s waits for tables that are in use", step.name)
        time.sleep(LOCK_TIMEOUT_SECONDS)


def wait_for_tables(conninfo: str, seconds: float = MAX_WAIT_SECONDS) -> None:
    """Wait until another process has migrated the tables to this version; changes nothing.

    Raises:
        DatabaseError: the database cannot be reached, is too new for this version, or nobody has.
    """
    deadline, is_reported = time.monotonic() + seconds, False
    while missing := _missing_in_database(conninfo):
        if time.monotonic() > deadline:
            raise DatabaseError(
                f"The database lacks tables of this version ({missing[0]}); start octasplat serve or the "
                "front end of this version, or run octasplat migrate."
            )
        if not is_reported:
            logger.warning("the database lacks tables of this version (%s); waiting for them", missing[0])
        is_reported = True
        time.sleep(1)


def missing_migrations(applied: set[tuple[str, str]]) -> list[str]:
    """Return names of this version's steps that are not among ``applied``, which are (component, name)."""
    return [step.name for step in all_migrations() if (step.component, step.name) not in applied]


def all_migrations() -> tuple[Migration, ...]:
    """Return every step of this version, in order."""
    return (
        *queue_migrations(),
        *_read_migrations(OWN_COMPONENT, resources.files("octasplat.workers.db") / "migrations"),
    )


def queue_migrations() -> tuple[Migration, ...]:
    """Return the steps of the queue's library."""
    return tuple(_read_migrations(QUEUE_COMPONENT, resources.files("procrastinate.sql") / "migrations"))


def _read_migrations(component: str, folder: Traversable) -> Iterator[Migration]:
    for file in sorted(folder.iterdir(), key=lambda file: file.name):
        if file.name.endswith(".sql"):
            yield Migration(component, file.name, file.read_text(encoding="utf-8"))


def _apply_missing(connection: psycopg.Connection, only: Collection[str] | None) -> Iterator[str]:
    connection.execute(_SCHEMA_TABLES)
    rows = connection.execute("SELECT component, name FROM schema_steps").fetchall()
    applied = {(str(component), str(name)) for component, name in rows}
    steps = all_migrations()
    if _is_newer(connection, applied):
        return
    if not any(component == QUEUE_COMPONENT for component, _ in applied):
        yield from _create_queue_schema(connection)
        steps = tuple(step for step in steps if step.component != QUEUE_COMPONENT)
    for step in steps:
        left_out = only is not None and step.component == OWN_COMPONENT and step.name not in only
        if (step.component, step.name) not in applied and not left_out:
            apply_step(connection, step)
            yield step.name
    connection.execute(
        """
        INSERT INTO schema_reach (oldest_reader) VALUES (%s)
        ON CONFLICT (one) DO UPDATE SET oldest_reader = excluded.oldest_reader
        """,
        [OLDEST_READER],
    )


def _is_newer(connection: psycopg.Connection, applied: set[tuple[str, str]]) -> bool:
    """Return whether a newer version made the tables.

    Raises:
        DatabaseError: one whose tables this version may not use.
    """
    steps = all_migrations()
    unknown = applied - {(step.component, step.name) for step in steps}
    if not unknown:
        return False
    reach = None
    if connection.execute("SELECT to_regclass('schema_reach') IS NOT NULL").fetchone() == (True,):
        reach = connection.execute("SELECT oldest_reader FROM schema_reach").fetchone()
    # Names of steps begin with padded numbers, so that they sort in the order of the steps.
    if (
        reach is None
        or missing_migrations(applied)
        or max(s.name for s in steps if s.component == OWN_COMPONENT) < reach[0]
    ):
        raise DatabaseError(
            f"The database was made by a newer version of octasplat (it has the step {max(unknown)[1]}); "
            "install that version. Nothing was changed."
        )
    logger.info("the tables are those of a newer version, beside which this one may go on")
    return True


def _missing_in_database(conninfo: str) -> list[str]:
    """Return steps that a database lacks."""
    try:
        with psycopg.connect(conninfo, autocommit=True, connect_timeout=10) as connection:
            if connection.execute("SELECT to_regclass('schema_steps') IS NULL").fetchone() == (True,):
                return missing_migrations(set())
            rows = connection.execute("SELECT component, name FROM schema_steps").fetchall()
            applied = {(str(component), str(name)) for component, name in rows}
            _is_newer(connection, applied)
            return missing_migrations(applied)
    except psycopg.OperationalError as error:
        raise _unreachable_error(error) from None


def _unreachable_error(error: psycopg.Error) -> DatabaseError:
    return DatabaseError(
        f"The database cannot be reached ({_one_line(error)}); check DATABASE_URL and that it runs."
    )


def _create_queue_schema(connection: psycopg.Connection) -> Iterator[str]:
    """Yield the queue's schema as it is now, which stands for all of its steps."""
    schema = (resources.files("procrastinate.sql") / "schema.sql").read_text(encoding="utf-8")
    with connection.transaction():
        connection.execute(schema)
        for step in queue_migrations():
            _record_migration(connection, step)
    yield "schema.sql"


def _record_migration(connection: psycopg.Connection, migration: Migration) -> None:
    connection.execute(
        "INSERT INTO schema_steps (component, name) VALUES (%s, %s)", [migration.component, migration.name]
    )


def _one_line(error: psycopg.Error) -> str:
    return " ".join(str(error).split()).rstrip(".")
