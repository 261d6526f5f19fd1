"""Factory of storages from their addresses."""

from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from octasplat.engine.core.errors import ConfigError
from octasplat.workers.storage.local import DEFAULT_FLOOR_BYTES, LocalStorage
from octasplat.workers.storage.protocol import Storage


def open_storage(address: str | Path, *, floor_bytes: int = DEFAULT_FLOOR_BYTES) -> Storage:
    """Open the store that ``address`` names.

    Args:
        address: a folder, ``file:///folder``, or ``s3://bucket/prefix``, the latter with
            ``?endpoint_url=https://...`` for a store that is not Amazon's. Credentials come from the usual
            AWS variables and files.
        floor_bytes: room that a folder's disk keeps free.

    Raises:
        ConfigError: the address cannot be understood or what it needs is not installed.
        StorageUnavailableError: the folder cannot be used.
    """
    folder = store_folder(address)
    if folder is not None:
        return LocalStorage(folder, floor_bytes=floor_bytes)
    parts = urlsplit(str(address))
    if parts.scheme != "s3" or not parts.netloc or parts.username:
        raise ConfigError(
            f"{parts.scheme}://... is not a store; name a folder or s3://bucket/prefix (no password in it)."
        )
    try:
        from octasplat.workers.storage.s3 import S3Storage
    except ModuleNotFoundError:
        raise ConfigError("A store in S3 needs boto3; install it with: pip install boto3") from None
    prefix = parts.path.strip("/")
    endpoint = parse_qs(parts.query).get("endpoint_url", [None])[0]
    return S3Storage(parts.netloc, f"{prefix}/" if prefix else "", endpoint_url=endpoint)


def store_folder(address: str | Path) -> Path | None:
    """Return the folder of the store that ``address`` names, absolute; None where it is no folder."""
    if isinstance(address, Path) or "://" not in address:
        return Path(address).absolute()
    parts = urlsplit(address)
    return Path(parts.path) if parts.scheme == "file" and parts.netloc in ("", "localhost") else None
