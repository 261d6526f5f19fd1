"""Quotas hold however many requests come at once."""

import asyncio
import uuid
from random import Random

import psycopg
import pytest
from click.testing import CliRunner
from psycopg.rows import dict_row
from psycopg.types.json import Jsonb

from octasplat.workers.cli.commands.quota import quota as quota_command
from octasplat.workers.db.connections import Connection, open_pool
from octasplat.workers.db.datasets import create_dataset, put_file
from octasplat.workers.db.locks import lock_owner
from octasplat.workers.db.quotas import (
    Quota,
    QuotaExceededError,
    Usage,
    bytes_left,
    check_bytes,
    check_new_dataset,
    check_new_job,
    quota_of,
    set_quota,
    usage_of,
)


async def connect(conninfo: str) -> Connection:
    return await psycopg.AsyncConnection.connect(conninfo, autocommit=True, row_factory=dict_row)


async def new_job(connection: Connection, owner: str, state: str = "queued") -> uuid.UUID:
    job_id = uuid.uuid4()
    await connection.execute(
        "INSERT INTO jobs (id, owner, kind, options, queue, state) VALUES (%s, %s, 'x', '{}', 'cpu', %s)",
        [job_id, owner, state],
    )
    return job_id


async def test_usage_counts_owner_contents(conninfo: str) -> None:
    connection = await connect(conninfo)
    mine = await create_dataset(connection, "me", "a")
    other = await create_dataset(connection, "other", "b")
    await put_file(connection, mine.id, "images/a.jpg", "a" * 64, 100)
    await put_file(connection, mine.id, "images/copy.jpg", "a" * 64, 100)
    await put_file(connection, mine.id, "images/b.jpg", "b" * 64, 10)
    await put_file(connection, other.id, "images/c.jpg", "c" * 64, 1000)
    done = await new_job(connection, "me", "succeeded")
    await new_job(connection, "me", "running")
    async with connection.transaction():
        await lock_owner(connection, "me")
        await connection.execute(
            "INSERT INTO artifacts (job_id, name, sha256, size_bytes, media_type) "
            "VALUES (%s, 'x', %s, 7, '')",
            [done, "d" * 64],
        )
    assert await usage_of(connection, "me") == Usage(bytes=117, datasets=1, jobs=1)
    assert await usage_of(connection, "nobody") == Usage(0, 0, 0)
    assert await bytes_left(connection, "me") is None
    assert await bytes_left(connection, "me", Quota(max_bytes=120)) == 3
    assert await bytes_left(connection, "me", Quota(max_bytes=50)) == 0
    await connection.close()


async def test_owner_quota_overrides_settings(conninfo: str) -> None:
    connection = await connect(conninfo)
    default = Quota(10, 20, 30)
    assert await quota_of(connection, "me", default) == default
    await set_quota(connection, "me", Quota(max_datasets=5))
    await set_quota(connection, "me", Quota(max_jobs=0))
    assert await quota_of(connection, "me", default) == Quota(10, 20, 0)
    with pytest.raises(QuotaExceededError) as caught:
        await check_new_job(connection, "me", default)
    assert caught.value.resource == "jobs"
    await check_new_job(connection, "other", default)
    await connection.close()


async def test_concurrent_requests_respect_quota(conninfo: str) -> None:
    quota = Quota(max_bytes=1000, max_datasets=3)

    async def make_dataset(number: int) -> bool:
        connection = await connect(conninfo)
        try:
            async with connection.transaction():
                await check_new_dataset(connection, "me", quota)
                await create_dataset(connection, "me", str(number))
        except QuotaExceededError as error:
            assert error.resource == "datasets"
            return False
        finally:
            await connection.close()
        return True

    async def upload(dataset_id: uuid.UUID, number: int) -> bool:
        connection = await connect(conninfo)
        try:
            async with connection.transaction():
                await put_file(connection, dataset_id, f"images/{number}.jpg", f"{number:064x}", 300)
                await check_bytes(connection, "me", quota)
        except QuotaExceededError as error:
            assert error.resource == "bytes" and "1200 bytes of your 1000" in str(error)
            return False
        finally:
            await connection.close()
        return True

    made = await asyncio.gather(*(make_dataset(number) for number in range(10)))
    assert sum(made) == 3
    connection = await connect(conninfo)
    cursor = await connection.execute("SELECT id FROM datasets")
    ids = [row["id"] for row in await cursor.fetchall()]
    stored = await asyncio.gather(*(upload(ids[number % 3], number) for number in range(10)))
    assert sum(stored) == 3
    assert (await usage_of(connection, "me")).bytes == 900
    await connection.close()


def test_quota_command_shows_and_sets_limits(conninfo: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DATABASE_URL", conninfo)
    run = CliRunner().invoke
    shown = run(quota_command, ["me"])
    assert shown.output.splitlines()[0] == "bytes: 0 of any number", shown.output
    run(quota_command, ["me", "--bytes", "20G"])
    lines = run(quota_command, ["me", "--jobs", "4"]).output.splitlines()
    assert lines == [
        "bytes: 0 of 20000000000",
        "datasets: 0 of any number",
        "unfinished jobs: 0 of 4",
        "share of the workers: 1",
    ]
    assert "unfinished jobs: 0 of any number" in run(quota_command, ["me", "--clear"]).output
    assert run(quota_command, ["me", "--jobs", "many"]).exit_code == 2


@pytest.mark.parametrize(
    "limit", [("--jobs", "3G"), ("--datasets", "3G"), ("--bytes", "10000000T"), ("--jobs", "²")]
)
def test_quota_command_refuses_limits_that_no_table_holds(
    conninfo: str, monkeypatch: pytest.MonkeyPatch, limit: tuple[str, str]
) -> None:
    monkeypatch.setenv("DATABASE_URL", conninfo)
    done = CliRunner().invoke(quota_command, ["me", *limit])
    assert done.exit_code == 2 and limit[1] in done.output


async def test_connection_pool_is_large_enough(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=2) as pool, pool.connection() as connection:
        await check_bytes(connection, "me", Quota(max_bytes=0))
        stats = pool.get_stats()
    assert stats["pool_size"] == 1 and not stats.get("requests_errors")  # no second connection was asked for


async def test_usage_count_matches_distinct_contents(conninfo: str) -> None:
    """Whatever comes, is replaced and goes, in any order, the count is that of all distinct contents."""
    truth = """
        SELECT coalesce(sum(size_bytes), 0)::bigint AS n FROM (
            SELECT f.sha256, f.size_bytes FROM dataset_files f JOIN datasets d ON d.id = f.dataset_id
            WHERE d.owner = 'me'
            UNION SELECT a.sha256, a.size_bytes FROM artifacts a JOIN jobs j ON j.id = a.job_id
            WHERE j.owner = 'me'
            UNION SELECT file->>'sha256', (file->>'size_bytes')::bigint
            FROM jobs j, jsonb_array_elements(j.checkpoint->'files') file WHERE j.owner = 'me'
        ) AS contents
        """
    random = Random(7)

    def content() -> tuple[str, int]:
        number = random.randrange(12)
        return f"{number:064x}", 10 * number + 1

    connection = await connect(conninfo)
    datasets = [(await create_dataset(connection, "me", str(n))).id for n in range(3)]
    jobs = [await new_job(connection, "me", "succeeded") for _ in range(3)]
    seen = set()
    for _ in range(150):
        sha256, size_bytes = content()
        async with connection.transaction():
            await lock_owner(connection, "me")
            match random.randrange(6):
                case 0 | 1:
                    path = f"images/{random.randrange(4)}.jpg"
                    await put_file(connection, random.choice(datasets), path, sha256, size_bytes)
                case 2:
                    await connection.execute(
                        "INSERT INTO artifacts VALUES (%s, %s, %s, %s, '') ON CONFLICT DO NOTHING",
                        [random.choice(jobs), str(random.randrange(3)), sha256, size_bytes],
                    )
                case 3:
                    files = [{"path": str(n), "sha256": s, "size_bytes": b} for n, (s, b) in
                             enumerate(content() for _ in range(3))]  # fmt: skip
                    kept = Jsonb({"files": files}) if random.random() < 0.7 else None
                    query = "UPDATE jobs SET checkpoint = %s WHERE id = %s"
                    await connection.execute(query, [kept, random.choice(jobs)])
                case 4:
                    gone = datasets.pop(random.randrange(3))
                    await connection.execute("DELETE FROM datasets WHERE id = %s", [gone])
                    datasets.append((await create_dataset(connection, "me", "again")).id)
                case 5:
                    gone = jobs.pop(random.randrange(3))
                    await connection.execute("DELETE FROM jobs WHERE id = %s", [gone])
                    jobs.append(await new_job(connection, "me", "succeeded"))
        row = await (await connection.execute(truth)).fetchone()
        assert row is not None and (await usage_of(connection, "me")).bytes == row["n"]
        seen.add(row["n"])
    assert len(seen) > 30
    await connection.close()
