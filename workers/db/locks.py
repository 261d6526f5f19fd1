"""Locks of transactions, and the one order in which they are taken.

1. An idempotency key (a row), on which duplicates of a request wait.
2. The lock of the storage (advisory): shared for transactions that reference contents, exclusive for
   those that mark unused ones.
3. The lock of an owner (advisory): the owner's usage is compared with the quota and counted.
4. The lock of a kind of task on datasets (advisory): tasks of an owner are counted and one is claimed.
5. Rows: jobs, blocks before the job that waits for them, then datasets, then whatever belongs to them.

So no transaction that has locked a row of a job or a dataset waits for an advisory lock: a heartbeat waits
for its row only as long as a few statements take. The storage, and anything else on the network, is not
accessed while one of these locks is held. Triggers of the database take the lock of an owner as well, so a
transaction that changes files of datasets, results or checkpoints, or deletes a dataset or a job, takes it
first. The tests run on a database that refuses any other order (``tests/support/lock_order_check.py``).
"""

from octasplat.workers.db.connections import Connection

STORE = 0x73746F72  # "stor"
ROW_SECONDS = 10
"""A transaction that has locked a job and falls silent for so long is undone; its process is gone."""
OWNER = 0x71756F74  # "quot"; the database's triggers know it as well

TASKS = 0x7461736B  # "task"
RECOVERY = 0x7265636F  # "reco"


async def lock_store(connection: Connection, *, shared: bool) -> None:
    """Take the lock of the storage until the transaction ends."""
    name = "pg_advisory_xact_lock_shared" if shared else "pg_advisory_xact_lock"
    await connection.execute(f"SELECT {name}(%s)".encode(), [STORE])


async def lock_owner(connection: Connection, owner: str) -> None:
    """Take the lock of an owner until the transaction ends; harmless if it is held already."""
    await connection.execute("SELECT pg_advisory_xact_lock(%s, hashtext(%s))", [OWNER, owner])


async def lock_tasks(connection: Connection, kind: str) -> None:
    """Take the lock of a kind of task on datasets until the transaction ends."""
    await connection.execute("SELECT pg_advisory_xact_lock(%s, hashtext(%s))", [TASKS, kind])


async def try_lock_recovery(connection: Connection) -> bool:
    """Take the lock of recoveries until the transaction ends; False if another process has it.

    It is never waited for, and so has no place in the order.
    """
    cursor = await connection.execute("SELECT pg_try_advisory_xact_lock(%s) AS taken", [RECOVERY])
    row = await cursor.fetchone()
    return row is not None and bool(row["taken"])


async def about_to_lock_jobs(connection: Connection) -> None:
    """Bound the transaction, which is about to lock rows of jobs; called before whatever locks them.

    For all it knows the database would wait hours for a host that vanished. The tests see here that no row
    of a dataset is locked yet.
    """
    limit = "SELECT set_config('idle_in_transaction_session_timeout', %s, true)"
    await connection.execute(limit, [f"{ROW_SECONDS}s"])
