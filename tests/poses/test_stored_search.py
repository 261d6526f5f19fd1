"""The state of a search for poses that another host goes on from."""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from octasplat.engine.core.events import CheckpointWritten, Event
from octasplat.engine.poses import stored_search
from octasplat.engine.poses.stored_search import (
    DATABASE,
    STORED_DATABASE,
    STORED_FROM,
    SearchKeeper,
    adopt_stored_database,
    read_pairs,
    store_stopped_search,
    write_pairs,
)


def add_row(database: Path, number: int) -> None:
    with closing(sqlite3.connect(database)) as opened, opened:
        opened.execute("PRAGMA journal_mode=WAL")
        opened.execute("CREATE TABLE IF NOT EXISTS rows (number INTEGER)")
        opened.execute("INSERT INTO rows VALUES (?)", (number,))


def rows(database: Path) -> list[int]:
    with closing(sqlite3.connect(database)) as opened:
        return [number for (number,) in opened.execute("SELECT number FROM rows ORDER BY number")]


def test_another_folder_goes_on_from_what_was_kept(tmp_path: Path) -> None:
    database, other = tmp_path / DATABASE, tmp_path / "other"
    other.mkdir()
    heard = list[Event]()
    keeper = SearchKeeper(database, STORED_FROM, heard.append)
    add_row(database, 1)
    keeper.keep_at_times(1)
    assert heard == []  # the last state is not old
    keeper.keep(2)
    assert heard == [CheckpointWritten(2, str(tmp_path / STORED_DATABASE))]
    add_row(database, 2)  # what comes later is not in it
    (other / STORED_DATABASE).write_bytes((tmp_path / STORED_DATABASE).read_bytes())
    adopt_stored_database(other)
    assert [path.name for path in other.iterdir()] == [DATABASE]
    assert rows(other / DATABASE) == [1]


def test_state_is_kept_at_times_and_where_there_are_new_steps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stored_search, "_STORE_SECONDS", 0.0)
    database, heard = tmp_path / DATABASE, list[Event]()
    add_row(database, 1)
    keeper = SearchKeeper(database, STORED_FROM, heard.append)
    keeper.keep_at_times(40)  # as many as an earlier attempt has found
    keeper.keep(40)
    assert heard == []
    keeper.keep_at_times(60)
    keeper.keep(100, is_final=True)
    assert [event.iteration for event in heard if isinstance(event, CheckpointWritten)] == [60, 100]
    assert rows(tmp_path / STORED_DATABASE) == [1]


@pytest.mark.parametrize(("name", "photographs"), [(DATABASE, STORED_FROM - 1), ("thorough.db", 2000)])
def test_short_and_second_searches_are_not_kept(tmp_path: Path, name: str, photographs: int) -> None:
    heard = list[Event]()
    add_row(tmp_path / name, 1)
    SearchKeeper(tmp_path / name, photographs, heard.append).keep(5)
    assert heard == [] and [path.name for path in tmp_path.iterdir()] == [name]


def test_full_disk_costs_the_state_only(tmp_path: Path) -> None:
    heard = list[Event]()
    SearchKeeper(tmp_path / "missing" / DATABASE, STORED_FROM, heard.append).keep(5)
    assert heard == []


def test_killed_search_is_kept_with_what_it_wrote_last(tmp_path: Path) -> None:
    database = tmp_path / DATABASE
    add_row(database, 1)
    with closing(sqlite3.connect(database)) as left_open:  # its last rows are in a file beside it
        left_open.execute("PRAGMA wal_autocheckpoint=0")
        left_open.execute("INSERT INTO rows VALUES (2)")
        left_open.commit()
        assert (tmp_path / f"{DATABASE}-wal").stat().st_size > 0
        stored = store_stopped_search(tmp_path)
        assert stored == tmp_path / STORED_DATABASE
        (tmp_path / "alone").mkdir()
        alone = stored.rename(tmp_path / "alone" / DATABASE)
        assert rows(alone) == [1, 2]
    assert store_stopped_search(tmp_path / "alone" / "nothing") is None


def test_database_that_is_there_wins(tmp_path: Path) -> None:
    add_row(tmp_path / DATABASE, 1)
    add_row(tmp_path / STORED_DATABASE, 2)
    adopt_stored_database(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [DATABASE] and rows(tmp_path / DATABASE) == [1]


def test_pairs_of_a_quick_look_are_read_again(tmp_path: Path) -> None:
    assert read_pairs(tmp_path / DATABASE) is None
    write_pairs(tmp_path / DATABASE, [(0, 1), (0, 7)])
    assert read_pairs(tmp_path / DATABASE) == [(0, 1), (0, 7)]
    assert read_pairs(tmp_path / "thorough.db") is None
    (tmp_path / "pairs.json").write_text("[[0")
    assert read_pairs(tmp_path / DATABASE) is None
