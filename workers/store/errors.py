"""What can go wrong with stored bytes, each fit to be shown as it is."""

from octasplat.engine.errors import OctasplatError


class StorageError(OctasplatError):
    """Base of the errors of a store."""


class StorageFull(StorageError):
    """There is no room, or what is left is kept free on purpose; HTTP status 507."""


class StorageUnavailable(StorageError):
    """The store does not answer or refuses the service; later it may work."""


class DigestMismatch(StorageError):
    """The bytes that came are not those that were announced."""


class TooLarge(StorageError):
    """More bytes came than were announced or are allowed; HTTP status 413.

    ``max_bytes`` is the limit, None where more came than were announced.
    """

    def __init__(self, message: str, max_bytes: int | None = None) -> None:
        super().__init__(message)
        self.max_bytes = max_bytes


class BlobMissing(StorageError):
    """The store does not hold the content that was asked for."""
