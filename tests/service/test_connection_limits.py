"""Limits of connections follow from how many files the process may open."""

import resource

import pytest

from octasplat.service import connection_limits
from octasplat.service.connection_limits import connections_for, raise_file_limit

INFINITE = resource.RLIM_INFINITY


@pytest.mark.parametrize(
    ("soft", "hard", "set_to", "files"),
    [
        (1024, 4096, (4096, 4096), 4096),
        (256, INFINITE, (10_240, INFINITE), 10_240),
        (65_536, INFINITE, (65_536, INFINITE), 65_536),
        (INFINITE, INFINITE, None, 10_240),
    ],
)
def test_infinite_file_limits_are_not_set_and_leave_connections(
    monkeypatch: pytest.MonkeyPatch, soft: int, hard: int, set_to: tuple[int, int] | None, files: int
) -> None:
    calls: list[tuple[int, int]] = []
    monkeypatch.setattr(connection_limits.resource, "getrlimit", lambda _kind: (soft, hard))
    monkeypatch.setattr(connection_limits.resource, "setrlimit", lambda _kind, limits: calls.append(limits))
    assert raise_file_limit() == files
    assert calls == ([] if set_to is None else [set_to])
    assert connections_for(files) > 1000
