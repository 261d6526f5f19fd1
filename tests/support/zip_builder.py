"""ZIP files written byte by byte, so that every record can lie."""

import struct
import zlib
from dataclasses import dataclass, field
from typing import Any


def deflated(data: bytes) -> bytes:
    packer = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    return packer.compress(data) + packer.flush()


@dataclass
class ZipMember:
    """One entry; ``local`` and ``central`` overwrite fields of the headers, whatever is true."""

    name: str | bytes
    data: bytes = b""
    method: int = 8
    flags: int = 0x800
    mode: int = 0o100644
    descriptor: bytes | None = None
    packed: bytes | None = None
    local_extra: bytes = b""
    central_extra: bytes = b""
    before: bytes = b""
    local: dict[str, Any] = field(default_factory=dict)
    central: dict[str, Any] = field(default_factory=dict)


def build_zip(
    *members: ZipMember,
    prefix: bytes = b"",
    gap: bytes = b"",
    comment: bytes = b"",
    suffix: bytes = b"",
    directory_extra: bytes = b"",
    end: dict[str, int] | None = None,
) -> bytes:
    out = bytearray(prefix)
    central = bytearray()
    for member in members:
        out += member.before
        name = member.name if isinstance(member.name, bytes) else member.name.encode("utf-8", "surrogatepass")
        packed = member.packed
        if packed is None:
            packed = deflated(member.data) if member.method == 8 else member.data
        facts = {
            "flags": member.flags,
            "method": member.method,
            "crc": zlib.crc32(member.data),
            "packed": len(packed),
            "size": len(member.data),
            "name": name,
            "start": len(out),
            "disk": 0,
            "version": 20,
        }
        local, listed = {**facts, **member.local}, {**facts, **member.central}
        out += struct.pack(
            "<4s5H3I2H", b"PK\3\4", local["version"], local["flags"], local["method"], 0, 33, local["crc"],
            local["packed"], local["size"], len(local["name"]), len(member.local_extra),
        )  # fmt: skip
        out += local["name"] + member.local_extra + packed + (member.descriptor or b"")
        central += struct.pack(
            "<4s6H3I5H2I", b"PK\1\2", 0x0314, listed["version"], listed["flags"], listed["method"], 0, 33,
            listed["crc"], listed["packed"], listed["size"], len(listed["name"]),
            len(member.central_extra), 0, listed["disk"], 0, member.mode << 16, listed["start"],
        )  # fmt: skip
        central += listed["name"] + member.central_extra
    out += gap
    facts_end = {
        "disk": 0,
        "entries": len(members),
        "size": len(central) + len(directory_extra),
        "start": len(out),
        **(end or {}),
    }
    out += central + directory_extra
    out += struct.pack(
        "<4s4H2IH", b"PK\5\6", facts_end["disk"], facts_end["disk"], facts_end["entries"],
        facts_end["entries"], facts_end["size"], facts_end["start"], len(comment),
    )  # fmt: skip
    return bytes(out + comment + suffix)
