"""The same bits whatever the threads, the chunks, the hierarchy; and refreshing is as good as rebuilding."""

import os
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import FlatGaussians, concatenate
from octasplat.engine.trace.protocol import GaussianGradients, TraceResult
from tests.support.trace_scenes import (
    f32,
    hit_lists,
    in_plane,
    make_cloud,
    make_tracer,
    random_gradients,
    rays_inwards,
    same_bits,
)

RAYS = 700
Scene = tuple[FlatGaussians, np.ndarray, RayBatch]


@pytest.fixture(scope="module")
def scene() -> Scene:
    rng = np.random.default_rng(5)
    mixed = concatenate(
        [make_cloud(rng, 1500, degree=1), make_cloud(rng, 500, degree=1, size=0.3, logits=(-4, -3))]
    )
    plane = in_plane(rng, 300)
    plane.sh = np.concatenate([plane.sh, np.zeros((300, 3, 3), np.float32)], axis=1)
    cloud = concatenate([mixed, plane])
    return cloud, f32(rng.normal(size=(len(cloud), 2))), rays_inwards(rng, RAYS)


def run(scene: Scene, **options: object) -> tuple[TraceResult, GaussianGradients, list[list[int]]]:
    cloud, features, rays = scene
    tracer = make_tracer(cloud, features, **options)
    seen = tracer.trace(rays, record=True)
    assert seen.recording is not None
    lists = hit_lists(seen)
    return seen, tracer.backward(seen.recording, random_gradients(np.random.default_rng(1), RAYS, 2)), lists


@pytest.mark.parametrize(
    "options",
    [
        {"threads": 1},
        {"threads": 2},
        {"build_quality": 0},
        {"build_quality": 2},
        {"box_padding": 0.3},
        {"box_padding": 0.3, "build_quality": 2, "threads": 2},
    ],
)
def test_trace_is_bit_identical_across_options(scene: Scene, options: dict[str, float]) -> None:
    expected, found = run(scene, threads=1), run(scene, **options)
    same_bits(found[0], expected[0])
    same_bits(found[1], expected[1])
    assert found[2] == expected[2]
    assert max(map(len, expected[2])) > 100


SCRIPT = """
import hashlib, sys
from dataclasses import fields
import numpy as np
from tests.support.trace_scenes import make_cloud, make_tracer, random_gradients, rays_inwards
rng = np.random.default_rng(5)
tracer = make_tracer(make_cloud(rng, 1500, degree=1), threads=int(sys.argv[1]))
seen = tracer.trace(rays_inwards(rng, 900), record=True)
gradients = tracer.backward(seen.recording, random_gradients(rng, 900))
digest = hashlib.sha256()
for group in (seen, gradients):
    for field in fields(group):
        if isinstance(getattr(group, field.name), np.ndarray):
            digest.update(getattr(group, field.name).tobytes())
sys.stdout.write(digest.hexdigest())
"""


@pytest.mark.heavy
def test_trace_is_bit_identical_across_threads() -> None:
    digests = set()
    for threads in (1, 4):
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT, str(threads)],
            env={**os.environ, "NUMBA_NUM_THREADS": "4"},
            cwd=Path(__file__).parents[2],
            capture_output=True,
            text=True,
            check=True,
        )
        digests.add(done.stdout)
    assert len(digests) == 1


def test_ray_result_nearly_independent_of_packet(
    scene: Scene,
) -> None:
    """A packet rounds slopes against its own axis, so that a ray sees the same but for float32 rounding."""
    cloud, features, rays = scene
    tracer = make_tracer(cloud, features)
    whole = tracer.trace(rays)
    for chosen in (np.arange(RAYS)[::-1], np.arange(3, RAYS, 7), np.array([11]), np.repeat(np.arange(5), 9)):
        part = tracer.trace(rays[chosen])
        for name in ("rgb_srgb", "transmittance", "depth_sum", "depth_median", "normal_world", "features"):
            expected = getattr(whole, name)[chosen]
            np.testing.assert_allclose(getattr(part, name), expected, rtol=1e-6, atol=1e-6)


def test_recording_and_repeated_traces_are_bit_identical(
    scene: Scene,
) -> None:
    cloud, features, rays = scene
    tracer = make_tracer(cloud, features)
    first = tracer.trace(rays)
    same_bits(tracer.trace(rays, record=True), first)
    same_bits(tracer.trace(rays), first)


def nudge(cloud: FlatGaussians, rng: np.random.Generator, chosen: np.ndarray) -> None:
    """A training step's worth of change, small against the padding."""
    count = len(chosen)
    cloud.means_world[chosen] += f32(1e-3 * rng.normal(size=(count, 3)))
    cloud.quats_wxyz[chosen] += f32(1e-3 * rng.normal(size=(count, 4)))
    cloud.log_scales[chosen] += f32(1e-2 * rng.normal(size=(count, 2)))
    cloud.opacity_logits[chosen] += f32(1e-2 * rng.normal(size=count))
    cloud.sh[chosen] += f32(0.1 * rng.normal(size=(count, *cloud.sh.shape[1:])))


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_refresh_is_as_good_as_a_rebuild(rng: np.random.Generator, share: float) -> None:
    cloud = make_cloud(rng, 1500, size=0.1)
    rays = rays_inwards(rng, 400)
    tracer = make_tracer(cloud, box_padding=0.5)
    chosen = np.sort(rng.permutation(1500)[: int(1500 * share)]).astype(np.int32)
    before = tracer.trace(rays)
    nudge(cloud, rng, chosen)
    tracer.refresh(None if share == 1.0 else chosen)
    refreshed = tracer.trace(rays, record=True)
    rebuilt_tracer = make_tracer(cloud)
    rebuilt = rebuilt_tracer.trace(rays, record=True)
    same_bits(refreshed, rebuilt)
    assert not np.array_equal(before.transmittance, refreshed.transmittance)
    given = random_gradients(rng, 400)
    assert refreshed.recording is not None and rebuilt.recording is not None
    assert hit_lists(refreshed) == hit_lists(rebuilt)
    same_bits(tracer.backward(refreshed.recording, given), rebuilt_tracer.backward(rebuilt.recording, given))


def test_rebuilding_with_another_count(rng: np.random.Generator) -> None:
    small, large = make_cloud(rng, 200), make_cloud(rng, 900)
    rays = rays_inwards(rng, 100)
    tracer = make_tracer(small)
    for cloud in (large, small, large):
        tracer.build(cloud)
        same_bits(tracer.trace(rays), make_tracer(cloud).trace(rays))


def test_thread_count_is_per_tracer(rng: np.random.Generator) -> None:
    cloud, rays = make_cloud(rng, 20), rays_inwards(rng, 5)
    everything = make_tracer(cloud).threads
    make_tracer(cloud, threads=1).trace(rays)
    assert make_tracer(cloud).threads == everything == numba.config.NUMBA_NUM_THREADS
