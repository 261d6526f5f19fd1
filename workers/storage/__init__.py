"""Storage of datasets, checkpoints and results: a folder or a bucket, behind one protocol."""

from octasplat.workers.storage.errors import (
    BlobNotFoundError,
    ContentTooLargeError,
    DigestMismatchError,
    StorageError,
    StorageFullError,
    StorageUnavailableError,
)
from octasplat.workers.storage.factory import open_storage
from octasplat.workers.storage.protocol import Blob, BlobWriter, Storage, StoredBlob
from octasplat.workers.storage.trees import (
    Manifest,
    TreeFile,
    fetch_tree,
    publish_manifest,
    read_manifest,
    store_tree,
)

__all__ = [
    "Blob",
    "BlobNotFoundError",
    "BlobWriter",
    "ContentTooLargeError",
    "DigestMismatchError",
    "Manifest",
    "Storage",
    "StorageError",
    "StorageFullError",
    "StorageUnavailableError",
    "StoredBlob",
    "TreeFile",
    "fetch_tree",
    "open_storage",
    "publish_manifest",
    "read_manifest",
    "store_tree",
]
