"""What can go wrong with the database and in its tables, each fit to be shown as it is."""

from engine.errors import OctasplatError


class DatabaseError(OctasplatError):
    """The database cannot be started, reached or brought to this version's schema."""


class Conflict(OctasplatError):
    """The job or dataset is in a state that does not allow what was asked."""
