"""A live scene of many blocks is put together with one read of the store for each file that is new."""

import hashlib
import uuid
from collections.abc import Iterator
from typing import cast

import pytest

from octasplat.service import live_scene_file
from octasplat.service.live_scene_file import KeptRows, build_live_scene
from octasplat.workers.db.live_scenes import LiveBlock, LiveScene, ShownScene
from octasplat.workers.storage.protocol import Storage

BLOCKS = 200
HEADER = b"ply\nelement vertex %d\nproperty float x\nend_header\n"


class CountingStore:
    """Files of rows of four bytes, and how many were read."""

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.reads = 0

    def add(self, rows: list[bytes]) -> tuple[str, int]:
        content = HEADER % len(rows) + b"".join(rows)
        digest = hashlib.sha256(content).hexdigest()
        self.files[digest] = content
        return digest, len(rows)

    def read(self, sha256: str) -> Iterator[bytes]:
        self.reads += 1
        yield self.files[sha256]


def row(text: str) -> bytes:
    return text.encode().rjust(4)


@pytest.fixture
def store() -> CountingStore:
    return CountingStore()


def scene_of(store: CountingStore, finished: int) -> ShownScene:
    """A scene of which so many blocks are finished, each with a row more than before."""
    digest, count = store.add([row(f"c{number}") for number in range(1, BLOCKS + 1)])
    scene = LiveScene(uuid.UUID(int=1), digest, digest, 5, count, [1] * BLOCKS)
    numbers = range(1, finished + 1)
    blocks = {n: LiveBlock(*store.add([row(f"a{n}"), row(f"b{n}")]), 10) for n in numbers}
    return ShownScene(scene, blocks)


def build(store: CountingStore, shown: ShownScene, kept: KeptRows) -> bytes:
    return build_live_scene(cast(Storage, store), shown, kept)


def test_each_file_is_read_once(store: CountingStore) -> None:
    kept = KeptRows()
    first = build(store, scene_of(store, BLOCKS - 1), kept)
    assert store.reads == BLOCKS  # that of the whole, too
    assert build(store, scene_of(store, BLOCKS - 1), kept) == first and store.reads == BLOCKS
    every = build(store, scene_of(store, BLOCKS), kept)
    assert store.reads == BLOCKS + 1
    rows = [row(f"{letter}{n}") for n in range(1, BLOCKS + 1) for letter in "ab"]
    assert every == HEADER % len(rows) + b"".join(rows)
    assert first == HEADER % (len(rows) - 1) + b"".join(rows[:-2]) + row(f"c{BLOCKS}")


@pytest.mark.parametrize(("room", "reads"), [(0, 0), (-4, 3)], ids=["enough", "too little"])
def test_kept_rows_have_a_limit(
    store: CountingStore, monkeypatch: pytest.MonkeyPatch, room: int, reads: int
) -> None:
    """Where there is too little room for all, each of them lets go the one that is read next."""
    monkeypatch.setattr(live_scene_file, "MAX_KEPT_BYTES", 4 * (BLOCKS + 2 * 2) + room)
    kept, shown = KeptRows(), scene_of(store, 2)
    first = build(store, shown, kept)
    store.reads = 0
    assert build(store, shown, kept) == first and store.reads == reads
