"""Where datasets, checkpoints and results are kept: a folder or a bucket, behind one protocol."""

from workers.store.errors import (
    BlobMissing,
    DigestMismatch,
    StorageError,
    StorageFull,
    StorageUnavailable,
    TooLarge,
)
from workers.store.opening import open_storage
from workers.store.protocol import Blob, BlobWriter, Storage, StoredBlob
from workers.store.trees import Manifest, TreeFile, fetch_tree, publish_manifest, read_manifest, store_tree

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
