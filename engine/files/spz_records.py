"""What an SPZ may have beside its Gaussians: records of extensions, and a tree of levels of detail.

A record of Niantic's library says in which frame the file is stored; without it that is right, up, back, as
in glTF (https://github.com/nianticlabs/spz/blob/main/extensions/README.md). Spark adds to the Gaussians of a
scene coarser ones, which stand for some of them each, and stores half of every opacity
(https://github.com/sparkjsdev/spark/blob/main/rust/spark-lib/src/spz.rs).
"""

import struct
from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Float64

HAS_RECORDS, HAS_LEVELS = 0x02, 0x80
"""Flags of the header. Niantic's library knows the first one, Spark the second one."""
RIGHT_UP_BACK = "RUB"
"""Where x, y and z point in a file that says nothing else."""
COORDINATE_SYSTEM = 0xADBE0003
_FRAMES = (
    RIGHT_UP_BACK,  # not said
    *("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"),
    *("LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU"),
)
"""By the number in the record."""
_DIRECTIONS = {
    "R": (1, 0, 0), "L": (-1, 0, 0), "U": (0, 1, 0), "D": (0, -1, 0), "B": (0, 0, 1), "F": (0, 0, -1),
}  # fmt: skip
_NAMES = {0xADBE0002: "limits of a camera", 0x4E530001: "a georeference"}
_RECORD = struct.Struct("<II")


def parse_records(data: bytes) -> dict[int, bytes]:
    """Return the contents of records by their types; one that is cut and what follows it are left out."""
    found: dict[int, bytes] = {}
    start = 0
    while start + _RECORD.size <= len(data):
        kind, length = _RECORD.unpack_from(data, start)
        start += _RECORD.size
        if start + length > len(data):
            break
        found.setdefault(kind, data[start : start + length])
        start += length
    return found


def frame_of(records: Mapping[int, bytes]) -> str | None:
    """Return where x, y and z point by records, as in "RUB"; None where they name a frame unknown here."""
    content = records.get(COORDINATE_SYSTEM)
    if content is None:
        return RIGHT_UP_BACK
    number = int.from_bytes(content[:4], "little")
    return _FRAMES[number] if len(content) >= 4 and number < len(_FRAMES) else None


def right_up_back_from(frame: str) -> Float64[np.ndarray, "3 3"]:
    """Return the matrix from a frame to right, up, back, a rotation or a reflection.

    >>> right_up_back_from("RDF").astype(int).tolist()
    [[1, 0, 0], [0, -1, 0], [0, 0, -1]]
    """
    return np.array([_DIRECTIONS[letter] for letter in frame], np.float64).T


def unread_records_message(kinds: Iterable[int]) -> tuple[str, ...]:
    """Return what to tell of records that are not read."""
    names = [_NAMES.get(kind, f"0x{kind:08x}") for kind in kinds if kind != COORDINATE_SYSTEM]
    if not names:
        return ()
    return (f"Records of extensions of its SPZ were left out: {', '.join(names)}.",)
