"""What reading a damaged ``.npz`` archive may raise."""

import struct
import zipfile
import zlib

ARCHIVE_DAMAGE = (
    OSError, KeyError, ValueError, TypeError, AttributeError, EOFError, RuntimeError, MemoryError,
    OverflowError, struct.error, zlib.error, zipfile.BadZipFile,
)  # fmt: skip
"""A flipped bit can ask for encryption or a lengthy array."""
