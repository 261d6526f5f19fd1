"""What can go wrong with the database, each fit to be shown as it is."""

from engine.errors import OctasplatError


class DatabaseError(OctasplatError):
    """The database cannot be started, reached or brought to this version's schema."""
