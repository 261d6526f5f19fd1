"""What can go wrong with the database and in its tables, each fit to be shown as it is."""

from octasplat.engine.errors import OctasplatError


class DatabaseError(OctasplatError):
    """The database cannot be started, reached or brought to this version's schema."""


class Conflict(OctasplatError):
    """The job or dataset is in a state that does not allow what was asked."""


class Missing(OctasplatError):
    """What was asked for is not there, or not any more; ``what`` names its kind."""

    def __init__(self, what: str) -> None:
        super().__init__(f"There is no such {what}.")
        self.what = what
