"""Errors of the database and its tables; their messages can be shown to users."""

from octasplat.engine.core.errors import OctasplatError


class DatabaseError(OctasplatError):
    """The database cannot be started, reached or brought to this version's schema."""


class ConflictError(OctasplatError):
    """The job or dataset is in a state that does not allow what was asked."""

    error_type = "conflict"


class NotFoundError(OctasplatError):
    """A requested row does not exist, or does not any more; ``kind`` names its kind."""

    error_type = "missing"

    def __init__(self, kind: str) -> None:
        super().__init__(f"There is no such {kind}.")
        self.kind = kind
