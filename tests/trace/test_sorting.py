"""The sorts under the tracer against numpy's stable one, on any number of threads."""

import numpy as np
import pytest

from octasplat.engine.trace.cpu.kernels.radix_sort import sort_by_gaussian, stable_argsort


@pytest.mark.parametrize("threads", [1, 2, 7])
@pytest.mark.parametrize("count", [0, 1, 5000, 40_000])
def test_radix_sort_is_stable_for_64_bit_keys(count: int, threads: int) -> None:
    rng = np.random.default_rng(count)
    keys = rng.integers(0, 2**64, count, np.uint64, endpoint=False)
    keys[rng.random(count) < 0.3] = np.uint64(2**64 - 1)
    keys[rng.random(count) < 0.3] >>= np.uint64(55)
    before = keys.copy()
    order, found = stable_argsort(keys, 64, threads)
    np.testing.assert_array_equal(keys, before)
    np.testing.assert_array_equal(order, np.argsort(keys, kind="stable"))
    np.testing.assert_array_equal(found, np.sort(keys))


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize(
    ("count", "gaussians"), [(0, 5), (1, 1), (63, 1), (20_000, 3000), (20_000, 4_000_000)]
)
def test_hits_are_grouped_by_gaussian(count: int, gaussians: int, threads: int) -> None:
    ids = np.random.default_rng(1).integers(0, gaussians, count).astype(np.int32)
    order, found, starts = sort_by_gaussian(ids, gaussians, threads)
    np.testing.assert_array_equal(order, np.argsort(ids, kind="stable"))
    np.testing.assert_array_equal(found, ids[order])
    _, firsts = np.unique(found, return_index=True)
    np.testing.assert_array_equal(starts, [*firsts, count])
