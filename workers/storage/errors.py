"""What can go wrong with stored bytes, each fit to be shown as it is."""

from octasplat.engine.core.errors import OctasplatError


class StorageError(OctasplatError):
    """Base of the errors of a store."""


class StorageFullError(StorageError):
    """There is no room, or what is left is kept free on purpose; HTTP status 507."""


class StorageUnavailableError(StorageError):
    """The store does not answer or refuses the service; later it may work."""


class DigestMismatchError(StorageError):
    """The bytes that came are not those that were announced."""


class ContentTooLargeError(StorageError):
    """More bytes came than were announced or are allowed; HTTP status 413.

    ``max_bytes`` is the limit, None where more came than were announced.
    """

    def __init__(self, message: str, max_bytes: int | None = None) -> None:
        super().__init__(message)
        self.max_bytes = max_bytes


class BlobNotFoundError(StorageError):
    """The store does not hold the content that was asked for."""
