"""The PLY container: its header, and elements as numpy structured arrays.

Written here because the usual library is under the GPL. Reads ascii and both binary layouts; lists are read
where every row of an element has the same length (the triangles of a mesh), and elements after the last one
asked for are never touched.
"""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import numpy as np

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.writing import atomic_replace

SCALAR_TYPES: Mapping[str, str] = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
TYPE_NAMES: Mapping[str, str] = {
    "i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort",
    "i4": "int", "u4": "uint", "f4": "float", "f8": "double",
}  # fmt: skip
COUNT_SUFFIX = "__count"
"""A list property ``p`` becomes two fields: ``p`` itself and ``p`` + this, its length."""
# Far more than any program writes: a damaged header must not take all memory.
MAX_HEADER_BYTES = 1 << 20
MAX_ELEMENTS, MAX_PROPERTIES = 100, 10_000
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


@dataclass(frozen=True)
class PlyProperty:
    """One property: a scalar of numpy type ``kind``, or a list of them counted by ``count_kind``."""

    name: str
    kind: str
    count_kind: str | None = None


@dataclass(frozen=True)
class PlyElement:
    """One element and its properties, in file order."""

    name: str
    count: int
    properties: tuple[PlyProperty, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the properties, in file order."""
        return tuple(prop.name for prop in self.properties)

    @property
    def lists(self) -> tuple[PlyProperty, ...]:
        """Return the properties that are lists."""
        return tuple(prop for prop in self.properties if prop.count_kind is not None)

    def dtype(self, byte_order: str, lengths: Mapping[str, int]) -> np.dtype[np.void]:
        """Return the type of one row, given the length of each list property."""
        fields: list[tuple[str, str] | tuple[str, str, tuple[int, ...]]] = []
        for prop in self.properties:
            if prop.count_kind is None:
                fields.append((prop.name, byte_order + prop.kind))
            else:
                fields.append((prop.name + COUNT_SUFFIX, byte_order + prop.count_kind))
                fields.append((prop.name, byte_order + prop.kind, (lengths[prop.name],)))
        return np.dtype(fields)


@dataclass(frozen=True)
class PlyHeader:
    """Header of a PLY file; ``data_offset`` is the byte offset of its first element."""

    layout: str
    elements: tuple[PlyElement, ...]
    comments: tuple[str, ...]
    data_offset: int

    def element(self, name: str) -> PlyElement | None:
        """Return the element called ``name``, or None."""
        return next((element for element in self.elements if element.name == name), None)


@dataclass
class _HeaderDraft:
    layout: str = ""
    elements: list[tuple[str, int, dict[str, PlyProperty]]] = field(default_factory=list)
    properties: int = 0
    comments: list[str] = field(default_factory=list)


def read_ply_header(path: Path) -> PlyHeader:
    """Read and check the header of a PLY file.

    Raises:
        SceneFileError: the file cannot be read, is not a PLY, or its header is damaged.
    """
    try:
        with path.open("rb") as handle:
            return _parse_header(path, handle)
    except OSError as error:
        raise SceneFileError(f"{path}: cannot be read ({error.strerror or error}).") from error


def _parse_header(path: Path, handle: IO[bytes]) -> PlyHeader:
    if handle.readline(16).rstrip(b"\r\n") != b"ply":
        raise SceneFileError(f"{path}: is not a PLY file (it does not begin with the line 'ply').")
    draft = _HeaderDraft()
    while handle.tell() < MAX_HEADER_BYTES:
        line = handle.readline(MAX_HEADER_BYTES)
        if not line.endswith(b"\n"):
            break
        text = line.decode("utf-8", errors="replace").strip()  # comments may be in any encoding
        if text == "end_header":
            if not draft.layout:
                raise SceneFileError(f"{path}: the PLY header has no 'format' line.")
            elements = tuple(
                PlyElement(name, count, tuple(props.values())) for name, count, props in draft.elements
            )
            return PlyHeader(draft.layout, elements, tuple(draft.comments), handle.tell())
        try:
            _take_header_line(draft, text)
        except (ValueError, KeyError, IndexError) as error:
            raise SceneFileError(f"{path}: the PLY header line '{text[:80]}' is not understood.") from error
        if len(draft.elements) > MAX_ELEMENTS or draft.properties > MAX_PROPERTIES:
            raise SceneFileError(
                f"{path}: has more than {MAX_ELEMENTS} elements or {MAX_PROPERTIES} properties."
            )
    raise SceneFileError(
        f"{path}: the PLY header never ends (no 'end_header'); the file is truncated or damaged."
    )


def _take_header_line(draft: _HeaderDraft, text: str) -> None:
    """Add one header line to ``draft``; ValueError, KeyError or IndexError where it makes no sense."""
    words = text.split()
    keyword = words[0] if words else "comment"
    if keyword in ("comment", "obj_info"):
        draft.comments.append(text.partition(" ")[2])
    elif keyword == "format":
        if words[1] not in _BYTE_ORDERS:
            raise ValueError(words[1])
        draft.layout = words[1]
    elif keyword == "element":
        name, count = words[1], int(words[2])
        if count < 0 or any(name == other for other, _, _ in draft.elements):
            raise ValueError(text)
        draft.elements.append((name, count, {}))
    elif keyword == "property":
        properties = draft.elements[-1][2]
        if words[1] == "list":
            if SCALAR_TYPES[words[2]].startswith("f"):
                raise ValueError(text)
            prop = PlyProperty(words[4], SCALAR_TYPES[words[3]], SCALAR_TYPES[words[2]])
        else:
            prop = PlyProperty(words[2], SCALAR_TYPES[words[1]])
        if prop.name in properties:
            raise ValueError(text)
        properties[prop.name] = prop
        draft.properties += 1
    else:
        raise ValueError(keyword)


def read_ply(path: Path, names: Sequence[str]) -> tuple[PlyHeader, dict[str, np.ndarray]]:
    """Read the elements called ``names``, each as a structured array of one row per item.

    A list property ``p`` becomes the fields ``p`` (a fixed-length sub-array) and ``p__count``. Binary
    elements are memory-mapped copy-on-write, so that only the pages looked at cost memory.

    Raises:
        SceneFileError: the file is not a PLY, lacks an element, is truncated, or holds lists of unequal
            length.
    """
    header = read_ply_header(path)
    for name in names:
        if header.element(name) is None:
            found = ", ".join(element.name for element in header.elements) or "none"
            raise SceneFileError(f"{path}: has no element '{name}' (it has: {found}).")
    tables: dict[str, np.ndarray] = {}
    missing = set(names)
    rows = _ascii_tables(path, header) if header.layout == "ascii" else _binary_tables(path, header)
    while missing:
        name, table = next(rows)
        if name in missing:
            tables[name] = table
            missing.discard(name)
    return header, tables


def columns(table: np.ndarray, names: Sequence[str], rows_at_once: int = 16384) -> np.ndarray:
    """Return the scalar fields ``names`` of a table as a C-ordered float32 array (rows, len(names)).

    Other numeric types are converted; numbers beyond float32 become infinite.
    """
    result = np.empty((len(table), len(names)), dtype=np.float32)
    with np.errstate(over="ignore"):
        for start in range(
            0, len(table), rows_at_once
        ):  # a block stays in the cache while its fields are picked
            block = table[start : start + rows_at_once]
            for column, name in enumerate(names):
                result[start : start + rows_at_once, column] = block[name]
    return result


def _binary_tables(path: Path, header: PlyHeader) -> Iterator[tuple[str, np.ndarray]]:
    byte_order = _BYTE_ORDERS[header.layout]
    size = path.stat().st_size
    offset = header.data_offset
    for element in header.elements:
        lengths: dict[str, int] = {}
        if element.lists and element.count:
            lengths = _first_lengths(path, element, byte_order, offset)
        else:
            lengths = {prop.name: 0 for prop in element.lists}
        dtype = element.dtype(byte_order, lengths)
        needed = element.count * dtype.itemsize
        if offset + needed > size:
            raise _truncated_error(path, element, max(0, size - offset) // max(1, dtype.itemsize))
        table: np.ndarray
        if needed:  # an empty range cannot be mapped
            table = np.memmap(path, dtype=dtype, mode="c", offset=offset, shape=(element.count,))
        else:
            table = np.zeros(element.count, dtype=dtype)
        _check_lengths(path, element, table, lengths)
        yield element.name, table
        offset += needed


def _first_lengths(path: Path, element: PlyElement, byte_order: str, offset: int) -> dict[str, int]:
    """Return the list lengths of the first row, which all others must share."""
    lengths: dict[str, int] = {}
    with path.open("rb") as handle:
        handle.seek(offset)
        for prop in element.properties:
            if prop.count_kind is not None:
                count_type = np.dtype(byte_order + prop.count_kind)
                raw = handle.read(count_type.itemsize)
                if len(raw) < count_type.itemsize:
                    raise _truncated_error(path, element, 0)
                # a negative count fails in _check_lengths
                lengths[prop.name] = max(0, int(np.frombuffer(raw, dtype=count_type)[0]))
                # Before a row type of this length is made, which numpy would refuse with an error of its own
                if lengths[prop.name] > path.stat().st_size:
                    raise _truncated_error(path, element, 0)
                handle.seek(lengths[prop.name] * np.dtype(prop.kind).itemsize, 1)
            else:
                handle.seek(np.dtype(prop.kind).itemsize, 1)
    return lengths


def _ascii_tables(path: Path, header: PlyHeader) -> Iterator[tuple[str, np.ndarray]]:
    with path.open("rb") as handle:
        handle.seek(header.data_offset)
        for element in header.elements:
            yield element.name, _ascii_table(path, handle, element)


def _ascii_table(path: Path, handle: IO[bytes], element: PlyElement) -> np.ndarray:
    values = _ascii_values(path, handle, element)
    lengths: dict[str, int] = {}
    place = 0
    for prop in element.properties:
        if prop.count_kind is not None:
            known = len(values) > 0 and place < values.shape[1]
            lengths[prop.name] = min(max(0, int(values[0, place])), values.shape[1]) if known else 0
            place += lengths[prop.name]
        place += 1
    if len(values) and values.shape[1] != place:
        raise SceneFileError(
            f"{path}: the rows of element '{element.name}' hold {values.shape[1]} numbers, "
            f"but its properties ask for {place}."
        )
    table = np.zeros(len(values), dtype=element.dtype("=", lengths))
    if len(values) == 0:  # which has no columns either
        return table
    place = 0
    with np.errstate(over="ignore", invalid="ignore"):
        for prop in element.properties:
            if prop.count_kind is None:
                table[prop.name] = values[:, place]
            else:
                table[prop.name + COUNT_SUFFIX] = values[:, place]
                table[prop.name] = values[:, place + 1 : place + 1 + lengths[prop.name]]
                place += lengths[prop.name]
            place += 1
    _check_lengths(path, element, table, lengths)
    return table


def _ascii_values(path: Path, handle: IO[bytes], element: PlyElement) -> np.ndarray:
    """Read the numbers of all rows of ``element`` in float64; leave ``handle`` at the row after them."""
    if element.count == 0:
        return np.zeros((0, 0))
    lines = itertools.islice((line for line in handle if line.strip()), element.count)
    first = next(lines, None)
    if first is None:
        raise _truncated_error(path, element, 0)
    try:
        values: np.ndarray = np.loadtxt(
            itertools.chain([first], lines), dtype=np.float64, comments=None, ndmin=2
        )
    except ValueError as error:
        raise SceneFileError(
            f"{path}: the rows of element '{element.name}' are not all numbers in equal count ({error})."
        ) from error
    if len(values) < element.count:
        raise _truncated_error(path, element, len(values))
    return values


def _check_lengths(path: Path, element: PlyElement, table: np.ndarray, lengths: Mapping[str, int]) -> None:
    for prop in element.lists:
        if (table[prop.name + COUNT_SUFFIX] != lengths[prop.name]).any():
            raise SceneFileError(
                f"{path}: the lists '{prop.name}' of element '{element.name}' differ in length; "
                "triangulate the mesh and save it again."
            )


def _truncated_error(path: Path, element: PlyElement, found: int) -> SceneFileError:
    return SceneFileError(
        f"{path}: is truncated; element '{element.name}' should have {element.count} rows "
        f"but only {found} are there."
    )


@dataclass(frozen=True)
class PlyWriteElement:
    """An element to write: its row type (scalars, and lists made by `list_field`) and its rows in blocks."""

    name: str
    count: int
    dtype: np.dtype[np.void]
    blocks: Iterable[np.ndarray]


def list_field(
    name: str, kind: str, length: int, count_kind: str = "u1"
) -> list[tuple[str, str] | tuple[str, str, tuple[int, ...]]]:
    """Return the two dtype fields of a list of fixed ``length``; the first must be filled with ``length``."""
    return [(name + COUNT_SUFFIX, "<" + count_kind), (name, "<" + kind, (length,))]


def write_ply(path: Path, elements: Sequence[PlyWriteElement], comments: Sequence[str] = ()) -> None:
    """Write a binary little-endian PLY, atomically, block by block.

    Raises:
        SceneFileError: the file cannot be written.
    """
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    for element in elements:
        lines += [f"element {element.name} {element.count}", *_property_lines(element.dtype)]
    try:
        with atomic_replace(path) as temporary, temporary.open("wb") as handle:
            handle.write("\n".join([*lines, "end_header", ""]).encode())
            for element in elements:
                written = 0
                for block in element.blocks:
                    handle.write(np.ascontiguousarray(block, dtype=element.dtype).data)
                    written += len(block)
                assert written == element.count, f"{element.name}: {written} rows for {element.count}"
    except OSError as error:
        raise SceneFileError(f"{path}: cannot be written ({error.strerror or error}).") from error


def _property_lines(dtype: np.dtype[np.void]) -> Iterator[str]:
    assert dtype.names is not None
    for name in dtype.names:
        if name.endswith(COUNT_SUFFIX):
            continue
        kind = dtype[name]
        if kind.subdtype is None:
            yield f"property {TYPE_NAMES[kind.str[1:]]} {name}"
        else:
            counter = dtype[name + COUNT_SUFFIX]
            yield f"property list {TYPE_NAMES[counter.str[1:]]} {TYPE_NAMES[kind.subdtype[0].str[1:]]} {name}"
