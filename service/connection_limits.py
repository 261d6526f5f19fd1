"""Limits of the front end's connections, which follow from how many files it may have open."""

import resource
from collections.abc import Sequence
from dataclasses import dataclass

from pydantic import IPvAnyNetwork

ACCEPT_BACKLOG = 128
"""Connections accepted before any of them is looked at."""
MIN_BODY_BYTES = 1 << 16
_MIN_CONNECTIONS = 16
_UNLIMITED_OPEN_FILES = 10_240
"""What is used of an infinite limit; macOS allows each process as many."""


@dataclass(frozen=True)
class ConnectionLimits:
    """Limits of connections.

    Attributes:
        max_connections: of all together.
        max_per_address: of one address, but for proxies that are named.
        header_seconds: time for the headers of a request, from its first byte or the connection's start.
        body_seconds: time for each :data:`MIN_BODY_BYTES` of a body, or for what is left of it.
        reader_seconds: time in which a client takes as much of an answer.
        proxies: networks of proxies.
    """

    max_connections: int
    max_per_address: int
    header_seconds: float
    body_seconds: float
    reader_seconds: float
    proxies: Sequence[IPvAnyNetwork] = ()


def raise_file_limit() -> int:
    """Raise the limit of open files to the highest that is allowed, and return it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY:
        return _UNLIMITED_OPEN_FILES
    # macOS refuses an infinite soft limit.
    highest = max(soft, _UNLIMITED_OPEN_FILES) if hard == resource.RLIM_INFINITY else hard
    resource.setrlimit(resource.RLIMIT_NOFILE, (highest, hard))
    return highest


def connections_for(open_files: int) -> int:
    """Return how many connections leave enough of the open files for uploads, downloads and the database."""
    return max(_MIN_CONNECTIONS, open_files * 3 // 4 - ACCEPT_BACKLOG)
