"""Errors of the storage; their messages can be shown to users."""

from octasplat.engine.core.errors import OctasplatError


class StorageError(OctasplatError):
    """Base of the errors of a store."""


class StorageFullError(StorageError):
    """The storage is full, or the rest is kept free on purpose; HTTP status 507."""

    error_type = "storage_full"


class StorageUnavailableError(StorageError):
    """The storage does not answer or refuses the service; it may work later."""

    error_type = "storage_unavailable"


class DigestMismatchError(StorageError):
    """The received bytes do not match the announced digest or length."""

    error_type = "digest_mismatch"


class ContentTooLargeError(StorageError):
    """More bytes came than were announced or are allowed; HTTP status 413.

    ``max_bytes`` is the limit, None where more came than were announced.
    """

    error_type = "too_large"

    def __init__(self, message: str, max_bytes: int | None = None) -> None:
        super().__init__(message)
        self.max_bytes = max_bytes


class BlobNotFoundError(StorageError):
    """The storage does not hold the requested content."""

    error_type = "blob_missing"


class UntrustedFileError(StorageError):
    """A program has put something into its folder that is not taken from there, such as a link."""

    error_type = "not_a_file"
