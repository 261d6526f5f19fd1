"""The scene that is shown while blocks are trained: the coarse file, with those of trained blocks in it.

All of these files are written by :mod:`octasplat.workers.worker.live_scene`, with the same columns of
float32, so that their rows are put together as they are, without reading any number in them. Rows that were
read are kept by the digest of their file: a scene of hundreds of blocks would else take as many reads of the
store for each request, where one block has changed since the last.
"""

import hashlib
import logging
import re
import threading
from collections import OrderedDict
from dataclasses import dataclass, field

from octasplat.workers.db.live_scenes import ShownScene
from octasplat.workers.storage.errors import StorageError
from octasplat.workers.storage.protocol import Storage

MAX_BYTES = 16 << 20
"""Of any file, and of what is made of them; a live scene has 2 MB."""
MAX_KEPT_BYTES = 64 << 20
"""Of rows that are kept, those of some twenty scenes."""
MAX_HEADER_BYTES = 4096
_END = b"end_header\n"
_COUNT = re.compile(rb"^element vertex (\d{1,10})$", re.MULTILINE)
_COLUMN = re.compile(rb"^property float \w+$", re.MULTILINE)

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Rows:
    """Rows of a file; ``layout`` is its header without their number, in two parts."""

    layout: tuple[bytes, bytes]
    row_bytes: int
    data: bytes


@dataclass
class KeptRows:
    """Rows of files that were read, the least recently used of which are let go."""

    _rows: "OrderedDict[tuple[str, int], _Rows]" = field(default_factory=OrderedDict)
    _bytes: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def read(self, storage: Storage, sha256: str, count: int) -> _Rows:
        """Return the rows of a file, from the store if they are not kept.

        Raises:
            StorageError: it is gone, damaged, or no file of a live scene with so many Gaussians.
        """
        key = sha256, count
        with self._lock:
            if (known := self._rows.get(key)) is not None:
                self._rows.move_to_end(key)
                return known
        found = _read_rows(storage, sha256, count)
        with self._lock:
            if key not in self._rows:
                self._rows[key] = found
                self._bytes += len(found.data)
            while self._bytes > MAX_KEPT_BYTES:
                self._bytes -= len(self._rows.popitem(last=False)[1].data)
        return found


def build_live_scene(storage: Storage, shown: ShownScene, kept: KeptRows) -> bytes:
    """Return the PLY file of what is shown.

    Where the store has lost the file of a block, or it is not what it should be, the part of the whole stays.
    Where it has lost that of the whole, trained blocks are shown without the rest.

    Args:
        storage: the store.
        shown: what is shown.
        kept: rows that were read before; those that are read now are added.

    Raises:
        StorageError: there is nothing to show.
    """
    counts = shown.scene.block_gaussians or []
    whole: _Rows | None = None
    lost: StorageError | None = None
    try:
        whole = kept.read(storage, shown.scene.sha256, shown.scene.gaussians)
    except StorageError as error:
        logger.warning("the live scene of job %s is lost: %s", shown.scene.job_id, error)
        lost = error
    first, pieces, start = whole, [], 0
    size = 0
    for number, count in enumerate(counts, start=1):
        rows = _read_block(storage, shown, number, kept)
        if rows is not None and (first is None or rows.layout == first.layout):
            piece, first = rows.data, first or rows
        elif whole is not None:
            piece = whole.data[start * whole.row_bytes : (start + count) * whole.row_bytes]
        else:
            piece = b""
        start += count
        size += len(piece)
        if size > MAX_BYTES:
            break
        pieces.append(piece)
    if first is None:
        raise lost or StorageError("There is nothing to show of this training.")
    data = b"".join(pieces)
    before, after = first.layout
    return b"%belement vertex %d%b%b" % (before, len(data) // first.row_bytes, after, data)


def _read_block(storage: Storage, shown: ShownScene, number: int, kept: KeptRows) -> _Rows | None:
    """Return the rows of a trained block; None where there are none that can be shown."""
    block = shown.blocks.get(number)
    if block is None:
        return None
    try:
        return kept.read(storage, block.sha256, block.gaussians)
    except StorageError as error:
        logger.warning("what block %d of job %s shows is lost: %s", number, shown.scene.job_id, error)
        return None


def _read_rows(storage: Storage, sha256: str, count: int) -> _Rows:
    """Return the rows of a file.

    Raises:
        StorageError: it is gone, damaged, or no file of a live scene with so many Gaussians.
    """
    content = bytearray()
    for piece in storage.read(sha256):
        content += piece
        if len(content) > MAX_BYTES:
            raise StorageError(f"{sha256} is larger than any live scene.")
    if hashlib.sha256(content).hexdigest() != sha256:
        raise StorageError(f"{sha256} is damaged.")
    end = content.find(_END, 0, MAX_HEADER_BYTES) + len(_END)
    header, data = bytes(content[:end]), bytes(content[end:])
    found = list(_COUNT.finditer(header))
    row_bytes = 4 * len(_COLUMN.findall(header))
    is_sound = end >= len(_END) and len(found) == 1 and int(found[0][1]) == count
    if not is_sound or row_bytes == 0 or len(data) != count * row_bytes:
        raise StorageError(f"{sha256} is no file of a live scene with {count} Gaussians.")
    return _Rows((header[: found[0].start()], header[found[0].end() :]), row_bytes, data)
