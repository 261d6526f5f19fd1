"""Byte ranges as RFC 9110 reads them, however large their numbers are."""

import pytest
from starlette.requests import Request

from octasplat.service.problems import ProblemError
from octasplat.service.ranges import requested_ranges

SIZE_BYTES = 1000


def ranges_of(value: str) -> list[tuple[int, int]] | None:
    headers = [(b"range", value.encode())]
    return requested_ranges(Request({"type": "http", "method": "GET", "headers": headers}), '"e"', SIZE_BYTES)


@pytest.mark.parametrize("last", [2**31 - 1, 2**63 - 1, 2**64 - 1, 10**40])
def test_an_end_far_behind_the_content_means_its_end(last: int) -> None:
    # Programs ask so for all that there is.
    assert ranges_of(f"bytes=10-{last}") == [(10, SIZE_BYTES)]
    assert ranges_of(f"bytes=-{last}") == [(0, SIZE_BYTES)]


def test_a_beginning_far_behind_the_content_is_no_range() -> None:
    with pytest.raises(ProblemError) as refused:
        ranges_of(f"bytes={2**64 - 1}-")
    assert refused.value.status == 416


def test_numbers_that_take_long_to_read_are_refused() -> None:
    with pytest.raises(ProblemError) as refused:
        ranges_of(f"bytes=0-{'9' * 5000}")
    assert refused.value.status == 400
