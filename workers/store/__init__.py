"""Where datasets, checkpoints and results are kept: a folder or a bucket, behind one protocol."""

from octasplat.workers.store.errors import (
    BlobMissing,
    DigestMismatch,
    StorageError,
    StorageFull,
    StorageUnavailable,
    TooLarge,
)
from octasplat.workers.store.opening import open_storage
from octasplat.workers.store.protocol import Blob, BlobWriter, Storage, StoredBlob
from octasplat.workers.store.trees import (
    Manifest,
    TreeFile,
    fetch_tree,
    publish_manifest,
    read_manifest,
    store_tree,
)

__all__ = [
    "Blob",
    "BlobMissing",
    "BlobWriter",
    "DigestMismatch",
    "Manifest",
    "Storage",
    "StorageError",
    "StorageFull",
    "StorageUnavailable",
    "StoredBlob",
    "TooLarge",
    "TreeFile",
    "fetch_tree",
    "open_storage",
    "publish_manifest",
    "read_manifest",
    "store_tree",
]
