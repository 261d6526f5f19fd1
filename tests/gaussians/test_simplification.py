"""Fewer Gaussians that look alike: moments of pairs, and pictures beside those of the largest alone."""

import errno
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.files import read_scene
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.gaussians.frames import frames_from_normals, quaternions_from_matrices
from octasplat.engine.gaussians.model import FlatGaussians, concatenate
from octasplat.engine.gaussians.neighbor_pairs import choose_pairs
from octasplat.engine.gaussians.rows import row_arrays
from octasplat.engine.gaussians.simplification import simplify
from octasplat.engine.operations.simplify import OPERATION, SimplifyRequest
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import TraceSettings

Make = Callable[..., FlatGaussians]


def covariances(gaussians: FlatGaussians) -> np.ndarray:
    axes = gaussians.rotations[:, :, 1:].astype(np.float64) * gaussians.scales[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def sphere(count: int, seed: int = 0) -> FlatGaussians:
    """A painted ball of small opaque Gaussians, evenly spread."""
    rng = np.random.default_rng(seed)
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    normals = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], axis=1)
    rgb = 0.5 + 0.4 * np.sin(3 * normals + [0, 1, 2])
    return FlatGaussians(
        means_world=normals.astype(np.float32),
        quats_wxyz=quaternions_from_matrices(frames_from_normals(normals)).astype(np.float32),
        log_scales=np.float32(np.log(1.2 / np.sqrt(count)) + 0.1 * rng.standard_normal((count, 2))),
        opacity_logits=np.float32(2 + 0.3 * rng.standard_normal(count)),
        sh=((rgb - 0.5) / 0.28209479)[:, None].astype(np.float32),
    )


def picture(gaussians: FlatGaussians) -> np.ndarray:
    """Colors along a grid of rays towards the ball."""
    side = np.linspace(-1.2, 1.2, 48, dtype=np.float32)
    x, y = np.meshgrid(side, side)
    origins = np.stack([x, y, np.full_like(x, -4)], axis=-1).reshape(-1, 3)
    tracer = make_tracer(TraceSettings(), threads=1)
    tracer.build(gaussians)
    directions = np.broadcast_to(np.float32([0, 0, 1]), origins.shape)
    return tracer.trace(RayBatch(origins, np.ascontiguousarray(directions), 0.0)).rgb_srgb


def composited_mass(coplanar: FlatGaussians) -> float:
    """Opacity times area of Gaussians in the plane z = 0 together, by their alphas on a fine grid."""
    side = np.linspace(-3, 3, 1501)
    points = np.stack(np.meshgrid(side, side), axis=-1)
    seen = np.ones(points.shape[:2])
    for mean, covariance, opacity in zip(
        coplanar.means_world[:, :2], covariances(coplanar)[:, :2, :2], coplanar.opacities, strict=True
    ):
        away = points - mean
        squares = np.einsum("xyi,ij,xyj->xy", away, np.linalg.inv(covariance), away)
        seen *= 1.0 - float(opacity) * np.exp(-0.5 * squares)
    return float((1.0 - seen).sum() * (side[1] - side[0]) ** 2 / (2 * np.pi))


def test_two_in_one_place_are_no_wider_than_they_look() -> None:
    """Alphas composite: of two with opacity a, 2 a - a^2 / 2 of the area of one is left, not 2 a."""
    opacity, area = 0.7, 0.2 * 0.1
    pair = FlatGaussians(
        means_world=np.zeros((2, 3), np.float32),
        quats_wxyz=np.tile(np.float32([1, 0, 0, 0]), (2, 1)),
        log_scales=np.float32(np.log([[0.2, 0.1]] * 2)),
        opacity_logits=np.full(2, np.log(opacity / (1 - opacity)), np.float32),
        sh=np.zeros((2, 1, 3), np.float32),
    )
    one = simplify(pair, 1)
    assert one.opacities[0] * one.scales.prod() == pytest.approx((2 * opacity - opacity**2 / 2) * area)
    facing = replace(pair, means_world=np.float32([[0, 0, 0], [0.001, 0, 0]]))  # one behind the other
    assert simplify(facing, 1).scales.prod() == pytest.approx(one.scales.prod(), rel=1e-3)


def test_twice_the_same_ball_becomes_the_ball() -> None:
    ball = sphere(1000)
    twice = concatenate([ball, ball])
    errors = np.sqrt(((picture(simplify(twice, 1000)) - picture(twice)) ** 2).mean())
    assert errors < 0.015


def test_pair_has_mass_mean_and_covariance_of_its_mixture() -> None:
    rng = np.random.default_rng(1)
    frames = frames_from_normals(np.array([[0, 0, 1.0], [0, 0, -1.0]]))
    pair = FlatGaussians(
        means_world=np.float32([[0, 0, 0], [0.3, 0.1, 0]]),
        quats_wxyz=quaternions_from_matrices(frames).astype(np.float32),
        log_scales=np.float32(np.log([[0.2, 0.1], [0.15, 0.3]])),
        opacity_logits=np.float32([-1.5, -1.0]),
        sh=rng.standard_normal((2, 4, 3)).astype(np.float32),
    )
    one = simplify(pair, 1)
    masses = pair.opacities.astype(np.float64) * pair.scales.prod(axis=1)
    share = masses / masses.sum()
    mean = share @ pair.means_world
    apart = pair.means_world - mean
    expected = np.einsum("n,nij->ij", share, covariances(pair) + apart[:, :, None] * apart[:, None, :])
    np.testing.assert_allclose(one.means_world[0], mean, atol=1e-6)
    np.testing.assert_allclose(covariances(one)[0], expected, atol=1e-6)
    np.testing.assert_allclose(one.opacities[0] * one.scales.prod(), composited_mass(pair), rtol=1e-4)
    assert composited_mass(pair) < 0.98 * masses.sum()
    np.testing.assert_allclose(one.sh[0], np.einsum("n,nkc->kc", share, pair.sh), atol=1e-6)
    assert abs(one.rotations[0, 2, 0]) == pytest.approx(1)


def test_opaque_neighbours_keep_what_they_cover_as_area() -> None:
    ball = sphere(400)
    fewer = simplify(ball, 100)
    mass = lambda g: float((g.opacities.astype(np.float64) * g.scales.prod(axis=1)).sum())  # noqa: E731
    assert len(fewer) == 100 and 0.8 * mass(ball) < mass(fewer) < 0.97 * mass(ball)  # they overlap
    assert fewer.opacities.max() <= 0.995 + 1e-6 and fewer.is_finite()
    outward = (fewer.rotations[:, :, 0] * fewer.means_world).sum(axis=1)
    assert (outward > 0).all()  # normals stay on their side


def test_half_of_a_ball_looks_nearly_like_all_of_it(tmp_path: Path) -> None:
    ball = sphere(6000)
    whole, fewer = picture(ball), simplify(ball, 3000)
    largest = ball.select(np.sort(np.argsort(-ball.opacities * ball.scales.prod(axis=1))[:3000]))
    errors = [np.sqrt(((picture(scene) - whole) ** 2).mean()) for scene in (fewer, largest)]
    assert errors[0] < 0.05 and errors[0] < 0.35 * errors[1]
    again = simplify(ball, 3000, folder=tmp_path)  # in files without a name
    for name, array in row_arrays(again).items():
        np.testing.assert_array_equal(row_arrays(fewer)[name], array)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("place", ["/proc", "none", "unmapped"])
def test_without_files_the_result_is_made_in_memory(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ball = sphere(40)
    expected = row_arrays(simplify(ball, 20))
    if place == "unmapped":  # as of a shared folder of another machine

        def refuse(*_args: object, **_options: object) -> None:
            raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))

        (tmp_path / place).mkdir()
        monkeypatch.setattr(np, "memmap", refuse)
    for name, array in row_arrays(simplify(ball, 20, folder=tmp_path / place)).items():
        np.testing.assert_array_equal(array, expected[name])


def test_a_disk_with_room_for_the_result_alone_is_enough(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_gaussian_ply(sphere(40), tmp_path / "ball.ply")

    def refuse(*_args: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", refuse)
    made = SimplifyRequest(source=tmp_path / "ball.ply", output=tmp_path / "less.ply", count=20)
    assert OPERATION.run(made).kept == 20


def test_of_pairs_that_cost_the_same_the_first_are_chosen() -> None:
    """A square, whose four sides are alike, and of which two without a common corner are chosen."""
    square = sphere(4)
    square.means_world[:] = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    for name, value in (("log_scales", -2), ("opacity_logits", 0), ("sh", 0), ("quats_wxyz", [1, 0, 0, 0])):
        getattr(square, name)[:] = np.float32(value)
    square.quats_wxyz[:] = np.float32([0.5**0.5, 0, 0.5**0.5, 0])  # they lie in the square
    assert [rows.tolist() for rows in choose_pairs(square, 2)] == [[0, 2], [1, 3]]
    assert [rows.tolist() for rows in choose_pairs(square, 1)] == [[0], [1]]


def test_unlike_colors_are_merged_last(make_gaussians: Make) -> None:
    row = sphere(60)
    red = row.means_world[:, 0] > 0
    row.sh[:, 0] = np.where(red[:, None], np.float32([1.5, -1.5, -1.5]), np.float32([-1.5, -1.5, 1.5]))
    fewer = simplify(row, 12)
    assert len(np.unique(fewer.sh[:, 0].round(3), axis=0)) == 2
    assert len(simplify(make_gaussians(7), 7)) == len(simplify(make_gaussians(7), 100)) == 7
    assert len(simplify(make_gaussians(7, sh_degree=2), 1)) == 1


@pytest.mark.parametrize("log_scale", [88.0, 88.72, 89.0, 3e38])
def test_sizes_beyond_float32_are_merged(make_gaussians: Make, tmp_path: Path, log_scale: float) -> None:
    gaussians = make_gaussians(20)
    gaussians.log_scales[3:6] = log_scale
    write_gaussian_ply(gaussians, tmp_path / "a.ply")
    found = OPERATION.run(SimplifyRequest(source=tmp_path / "a.ply", output=tmp_path / "b.ply", count=1))
    left, _ = read_scene(tmp_path / "b.ply")
    assert found.kept == len(left) == 1 and left.is_finite()
    assert 87 < left.log_scales.max() < 88.73


def test_channels_of_pairs_are_means_or_those_of_the_larger() -> None:
    near = sphere(2)
    near.means_world[:] = [[0, 0, 1], [0.01, 0, 1]]
    near.log_scales[:] = np.log([[0.2, 0.2], [0.1, 0.1]])
    near.opacity_logits[:] = 0
    channels = {
        "albedo": np.float32([[0.2, 0.2, 0.2], [0.7, 0.7, 0.7]]), "metallic": np.float32([[0], [1]]),
        "roughness": np.float32([[0.5], [0.5]]), "label": np.float32([[3], [8]]),
    }  # fmt: skip
    one = simplify(near.with_channels(channels), 1)
    assert one.channels["label"][0] == 3
    np.testing.assert_allclose(one.channels["albedo"][0], 0.3, atol=1e-6)
    np.testing.assert_allclose(one.channels["metallic"][0], 0.2, atol=1e-6)
    channels = {name: array * np.float32([[0], [1]]) for name, array in channels.items()}
    unknown = simplify(near.with_channels(channels), 1)
    np.testing.assert_allclose(unknown.channels["albedo"][0], 0.7, atol=1e-6)


def test_rounds_are_told_and_may_stop() -> None:
    told: list[int] = []
    simplify(sphere(200), 50, told.append)
    assert told[-1] == 50 and told == sorted(told, reverse=True) and len(told) > 3

    def stop(left: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simplify(sphere(200), 50, stop)
