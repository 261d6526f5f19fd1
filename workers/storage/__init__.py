"""Where datasets, checkpoints and results are kept: a folder or a bucket, behind one protocol."""

from workers.storage.errors import (
    BlobMissing,
    DigestMismatch,
    StorageError,
    StorageFull,
    StorageUnavailable,
    TooLarge,
)
from workers.storage.opening import open_storage
from workers.storage.protocol import Blob, BlobWriter, Storage, StoredBlob
from workers.storage.trees import Manifest, TreeFile, fetch_tree, publish_manifest, read_manifest, store_tree

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
