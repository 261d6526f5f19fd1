from collections.abc import Iterator

import numpy as np
import pytest
import torch

from tests.support import trace_scenes


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20)


@pytest.fixture(scope="package", autouse=True)
def one_torch_thread() -> Iterator[None]:
    """The twin's arrays are small: more threads only get in each other's way."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(params=["always", "never"])
def both_ways(request: pytest.FixtureRequest) -> Iterator[str]:
    """Runs a test with packets and with single rays."""
    trace_scenes.PACKETS[0] = request.param
    yield request.param
    trace_scenes.PACKETS[0] = "auto"
