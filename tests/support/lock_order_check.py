"""Makes a database refuse locks that are taken in another order than that of ``workers/db/locks.py``.

Functions of the names of Postgres's own stand before these in the search path of the database, so that every
lock that a process or a trigger takes in a test is seen, whichever code it comes from. That rows of jobs are
about to be locked is seen in ``set_config``, which bounds the transaction of whoever locks one
(``workers/db/locks.py``), and by a trigger of the table.
"""

import psycopg
from psycopg import sql

_CHECKS = """
CREATE SCHEMA lock_order;
CREATE FUNCTION lock_order.holds(first bigint, second bigint, sub integer) RETURNS boolean LANGUAGE sql AS $$
    SELECT EXISTS (SELECT FROM pg_catalog.pg_locks WHERE pid = pg_catalog.pg_backend_pid()
        AND locktype = 'advisory' AND granted AND (second IS NULL OR objid = second::oid)
        AND (first IS NULL OR classid = first::oid) AND objsubid = sub)
$$;
CREATE FUNCTION lock_order.check_rows(what text) RETURNS void LANGUAGE plpgsql AS $$
DECLARE
    locked text;
BEGIN
    SELECT string_agg(DISTINCT relation::regclass::text, ', ') INTO locked FROM pg_catalog.pg_locks
    WHERE pid = pg_catalog.pg_backend_pid() AND locktype = 'relation'
      AND relation IN ('public.jobs'::regclass, 'public.datasets'::regclass)
      AND mode IN ('RowShareLock', 'RowExclusiveLock');
    IF locked IS NOT NULL THEN
        RAISE EXCEPTION 'order of locks: % is waited for while rows of % are locked', what, locked;
    END IF;
END;
$$;
CREATE FUNCTION lock_order.pg_advisory_xact_lock(first integer, second integer) RETURNS void
LANGUAGE plpgsql AS $$
BEGIN
    IF NOT lock_order.holds(first, second & 4294967295, 2) THEN
        PERFORM lock_order.check_rows('the lock of an owner');
    END IF;
    PERFORM pg_catalog.pg_advisory_xact_lock(first, second);
END;
$$;
CREATE FUNCTION lock_order.pg_advisory_xact_lock(key bigint) RETURNS void LANGUAGE plpgsql AS $$
BEGIN
    PERFORM lock_order.check_store();
    PERFORM pg_catalog.pg_advisory_xact_lock(key);
END;
$$;
CREATE FUNCTION lock_order.pg_advisory_xact_lock_shared(key bigint) RETURNS void LANGUAGE plpgsql AS $$
BEGIN
    PERFORM lock_order.check_store();
    PERFORM pg_catalog.pg_advisory_xact_lock_shared(key);
END;
$$;
CREATE FUNCTION lock_order.check_store() RETURNS void LANGUAGE plpgsql AS $$
BEGIN
    PERFORM lock_order.check_rows('the lock of the store');
    IF lock_order.holds(NULL, NULL, 2) THEN
        RAISE EXCEPTION 'order of locks: the lock of the store is waited for while an owner''s is held';
    END IF;
END;
$$;
-- Rows of jobs are about to be locked: none of a dataset is locked by then, if none of a job was before.
CREATE FUNCTION lock_order.check_jobs() RETURNS void LANGUAGE plpgsql AS $$
BEGIN
    IF pg_catalog.current_setting('lock_order.jobs', true) = 'locked' THEN
        RETURN;
    END IF;
    IF EXISTS (SELECT FROM pg_catalog.pg_locks WHERE pid = pg_catalog.pg_backend_pid()
            AND locktype = 'relation' AND relation = 'public.datasets'::regclass
            AND mode IN ('RowShareLock', 'RowExclusiveLock')) THEN
        RAISE EXCEPTION 'order of locks: rows of jobs are waited for while rows of datasets are locked';
    END IF;
    PERFORM pg_catalog.set_config('lock_order.jobs', 'locked', true);
END;
$$;
CREATE FUNCTION lock_order.set_config(name text, value text, is_local boolean) RETURNS text
LANGUAGE plpgsql AS $$
BEGIN
    IF name = 'idle_in_transaction_session_timeout' AND is_local THEN
        PERFORM lock_order.check_jobs();
    END IF;
    RETURN pg_catalog.set_config(name, value, is_local);
END;
$$;
CREATE FUNCTION lock_order.before_jobs() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    PERFORM lock_order.check_jobs();
    RETURN NULL;
END;
$$;
CREATE TRIGGER lock_order BEFORE UPDATE OR DELETE ON public.jobs
    FOR EACH STATEMENT EXECUTE FUNCTION lock_order.before_jobs();
"""


def install_lock_order_checks(conninfo: str) -> None:
    """Put the checks into a database; connections that are made later have them."""
    with psycopg.connect(conninfo, autocommit=True) as connection:
        connection.execute(_CHECKS)
        name = sql.Identifier(connection.info.dbname)
        path = "public, lock_order, pg_catalog"  # where tables are made comes first
        connection.execute(
            sql.SQL("ALTER DATABASE {} SET search_path = " + path).format(name)  # type: ignore[arg-type]
        )


def remove_lock_order_checks(conninfo: str) -> None:
    """Leave a database without them, for versions that keep to no order."""
    with psycopg.connect(conninfo, autocommit=True) as connection:
        name = sql.Identifier(connection.info.dbname)
        connection.execute(sql.SQL("ALTER DATABASE {} RESET search_path").format(name))
        connection.execute("DROP SCHEMA lock_order CASCADE")
