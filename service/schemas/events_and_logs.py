"""Bodies of the routes on a job's log and events."""

from datetime import datetime
from typing import Any

from pydantic import BaseModel, Field

from octasplat.workers.db.rows import JobEvent, LogLine


class LogLineView(BaseModel):
    """A line of a job's log."""

    id: int = Field(description="Number among the lines of the job.")
    attempt: int
    text: str
    at: datetime

    @classmethod
    def from_row(cls, row: LogLine) -> "LogLineView":
        """Return the view of a database row."""
        return cls(id=row.number, attempt=row.attempt, text=row.text, at=row.at)


class LogPage(BaseModel):
    """A page of a job's log; for the next, set `after` to `next`."""

    lines: list[LogLineView]
    next: int


class EventView(BaseModel):
    """An event of a job."""

    id: int = Field(description="Number among the events of the job.")
    attempt: int
    kind: str
    data: dict[str, Any]
    at: datetime

    @classmethod
    def from_row(cls, row: JobEvent) -> "EventView":
        """Return the view of a database row."""
        return cls(id=row.number, attempt=row.attempt, kind=row.kind, data=row.data, at=row.at)


class EventPage(BaseModel):
    """A page of events; for the next, set `after` to `next`."""

    events: list[EventView]
    next: int
