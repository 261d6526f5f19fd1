from collections.abc import Iterator

import numba
import pytest


@pytest.fixture(autouse=True)
def threads_as_before() -> Iterator[None]:
    """A tracer sets the number of threads of the whole process."""
    before = numba.get_num_threads()
    yield
    numba.set_num_threads(before)
