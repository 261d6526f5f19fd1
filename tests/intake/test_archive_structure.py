"""Archives whose structure contradicts itself are refused, each for its own reason."""

import struct
from collections.abc import Callable
from dataclasses import replace

import pytest

from octasplat.workers.storage.local import LocalStorage
from tests.support.archive_intake import PHOTO, good, refusal, take
from tests.support.zip_builder import ZipMember, build_zip


def field_zip64(*values: int) -> bytes:
    return struct.pack(f"<2H{len(values)}Q", 1, 8 * len(values), *values)


STRUCTURES: dict[str, tuple[Callable[[], bytes], str]] = {
    "data after the end": (lambda: build_zip(good(), suffix=b"x"), "archive-data-after-end"),
    "archive after the archive": (
        lambda: build_zip(good(), suffix=build_zip(good("images/b.jpg"))), "archive-gap",
    ),
    "data before the beginning": (lambda: build_zip(good(), prefix=b"PK\3\4#!/bin/sh\n"), "archive-gap"),
    "gap between entries": (
        lambda: build_zip(good(), replace(good("images/b.jpg"), before=b"hidden")), "archive-gap",
    ),
    "gap before the directory": (lambda: build_zip(good(), gap=b"hidden"), "archive-gap"),
    "bytes in the directory": (lambda: build_zip(good(), directory_extra=b"hidden"), "archive-gap"),
    "entry that is not listed": (lambda: unlisted(), "archive-gap"),
    "end record in the comment": (
        lambda: build_zip(good(), comment=b"PK\5\6" + bytes(30)), "archive-data-after-end",
    ),
    "whole end record in the comment": (
        lambda: build_zip(good(), comment=struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 0, 0, 0, 0, 0)),
        "archive-gap",
    ),
    "another name": (lambda: build_zip(replace(good(), local={"name": b"images/x.jpg"})), "archive-mismatch"),
    "another method": (lambda: build_zip(replace(good(), local={"method": 0})), "archive-mismatch"),
    "another length": (lambda: build_zip(replace(good(), local={"size": 3})), "archive-mismatch"),
    "another packed length": (lambda: build_zip(replace(good(), local={"packed": 3})), "archive-mismatch"),
    "another checksum": (lambda: build_zip(replace(good(), local={"crc": 3})), "archive-mismatch"),
    "other flags": (lambda: build_zip(replace(good(), local={"flags": 0x801})), "archive-mismatch"),
    "no local header": (lambda: build_zip(replace(good(), central={"start": 4})), "archive-mismatch"),
    "start outside": (lambda: build_zip(replace(good(), central={"start": 2**31})), "archive-mismatch"),
    "second name": (
        lambda: build_zip(
            replace(good(), central_extra=struct.pack("<2HBI", 0x7075, 17, 1, 0) + b"images/x.jpg")
        ),
        "archive-second-name",
    ),
    "second local name": (
        lambda: build_zip(
            replace(good(), local_extra=struct.pack("<2HBI", 0x7075, 17, 1, 0) + b"images/x.jpg")
        ),
        "archive-second-name",
    ),
    "descriptor that lies": (
        lambda: build_zip(replace(good(), flags=0x808, descriptor=struct.pack("<3I", 1, 2, 3))),
        "archive-mismatch",
    ),
    "descriptor missing": (lambda: build_zip(replace(good(), flags=0x808)), "archive-mismatch"),
    "overlapping entries": (lambda: overlapping(), "archive-overlap"),
    "quoted overlap": (lambda: same_data_twice(), "archive-overlap"),
    "several disks": (lambda: build_zip(good(), end={"disk": 1}), "archive-several-disks"),
    "entry on another disk": (
        lambda: build_zip(replace(good(), central={"disk": 3})), "archive-several-disks",
    ),
    "too few entries announced": (lambda: build_zip(good(), good("b"), end={"entries": 1}), "archive-gap"),
    "too many entries announced": (lambda: build_zip(good(), end={"entries": 2}), "archive-damaged"),
    "needs a newer reader": (
        lambda: build_zip(replace(good(), central={"version": 64})), "archive-version",
    ),
    "needs a newer reader locally": (
        lambda: build_zip(replace(good(), local={"version": 700})), "archive-version",
    ),
    "encrypted": (lambda: build_zip(replace(good(), flags=0x801)), "archive-encrypted"),
    "unknown method": (lambda: build_zip(replace(good(), method=14)), "archive-method"),
    "zip64 without lengths": (
        lambda: build_zip(replace(good(), central={"size": 2**32 - 1})), "archive-damaged",
    ),
    "zip64 start beyond what a file can have": (
        lambda: build_zip(replace(good(), central={"start": 2**32 - 1}, central_extra=field_zip64(2**63))),
        "archive-mismatch",
    ),
    "zip64 length that lies": (
        lambda: build_zip(replace(good(), central={"size": 2**32 - 1}, central_extra=field_zip64(2**50))),
        "archive-mismatch",
    ),
    "cut short": (lambda: build_zip(good())[:-30], "archive-damaged"),
    "only a head": (lambda: b"PK\3\4", "archive-damaged"),
    "damaged extra data": (
        lambda: build_zip(replace(good(), central_extra=b"\1\0\xff\xff..")), "archive-damaged",
    ),
    "empty": (lambda: build_zip(), "archive-empty"),
    "no scene inside": (lambda: build_zip(ZipMember("README.md", b"hello")), "archive-empty"),
    "folder with a content": (
        lambda: build_zip(good(), ZipMember("images/x/", b"abcdef", method=0, mode=0)), "archive-mismatch",
    ),
    "name in another code": (
        lambda: build_zip(ZipMember(b"images/\x84.jpg", PHOTO, flags=0)), "name-not-text",
    ),
    "not an archive": (lambda: PHOTO, "archive-damaged"),
    "nothing": (lambda: b"", "archive-damaged"),
}  # fmt: skip


def unlisted() -> bytes:
    """Two entries in the file, one in the list of contents."""
    both = build_zip(good(), good("images/b.jpg"))
    first_only = build_zip(good())
    start = both.index(b"PK\1\2")
    central = first_only[first_only.index(b"PK\1\2") : first_only.index(b"PK\5\6")]
    end = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 1, 1, len(central), start, 0)
    return both[:start] + central + end


def overlapping() -> bytes:
    """The first entry reaches over the second, as in the bombs that share one kernel."""
    inner = build_zip(good("images/b.jpg"))
    inner = inner[: inner.index(b"PK\1\2")]
    outer = ZipMember("images/a.jpg", inner, method=0)
    second = ZipMember("images/b.jpg", PHOTO)
    data = build_zip(outer, second)
    start = data.index(inner)
    body = data[: start + len(inner)]
    whole = build_zip(outer, replace(second, central={"start": start}))
    central = whole[whole.index(b"PK\1\2") : whole.index(b"PK\5\6")]
    return body + central + struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 2, 2, len(central), len(body), 0)


def same_data_twice() -> bytes:
    return build_zip(good(), replace(good(), central={"start": 0}))


@pytest.mark.parametrize("case", STRUCTURES)
def test_archive_inconsistent_structure_is_refused(local_storage: LocalStorage, case: str) -> None:
    make, code = STRUCTURES[case]
    assert refusal(make(), local_storage) == code


def test_refused_name_that_is_no_text_can_be_told(local_storage: LocalStorage) -> None:
    data = build_zip(good(), ZipMember(b"\xf4\xea", b"x", flags=0, local={"flags": 0x15D}))
    assert refusal(data, local_storage) == "archive-mismatch"


def test_two_end_records_are_ambiguous(local_storage: LocalStorage) -> None:
    first = build_zip(good())
    hidden = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 1, 1, 0, 0, 0)
    data = build_zip(replace(good(), central_extra=struct.pack("<2H", 0x9999, len(hidden)) + hidden))
    assert refusal(data, local_storage) == "archive-ambiguous"
    assert take(first, local_storage)
