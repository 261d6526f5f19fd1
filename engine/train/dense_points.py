"""More points to begin from: pixels lifted to the depth at which neighbouring photographs agree.

Structure from motion leaves plain walls, floors and leaves almost empty, and growth needs thousands of
iterations to carry Gaussians there. Here random pixels of the training views take the depths of the points
seen around them as guesses; each guess is judged by how well a small patch, moved into neighbouring views,
matches what they show. What agrees becomes a point, and serves as a guess in the next round.

A plane sweep on a few planes a pixel, after "A Space-Sweep Approach to True Multi-Image Matching"
(https://doi.org/10.1109/CVPR.1996.517097).
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from scipy.spatial import cKDTree

from engine.scene import Dataset
from engine.train.first_background import FirstBackground

GUESSES = 6
"""Depths tried for a pixel: those of the nearest points in the image."""
NEIGHBOURS = 4
"""Views in which a guess is judged; the better half of them counts, since the rest may be hidden."""
ROUNDS = 2
STEP_PX = 2
OFFSETS_PX = STEP_PX * np.array([[0, 0], [1, 1], [1, -1], [-1, 1], [-1, -1]], np.int64)
MAX_COST = 0.06
"""Mean difference of colour, in display values, above which no guess counts as right."""
AS_WELL = 0.005
"""A pixel that matches infinitely far away about as well as at any guess shows the sky."""
INFINITY = 1e6
"""So many times the largest depth."""
LEVEL_WEIGHT = 0.3
"""Weight of a difference in brightness against one in texture."""
LEAST_COSINE = 0.5
"""Neighbouring views look less than 60 degrees another way."""
BASELINE = 0.05
"""Distance of a good neighbouring view, of that to the points: less tells depths badly apart, more shows
other things."""
JURY = 24
"""Views that vote on each point."""
AGREES = 0.12
"""Largest mean difference of colour, in display values, of a view that agrees."""
MAJORITY = 0.3
"""Share of the views looking there that must agree: a point in free space hides other things in most."""


@dataclass(frozen=True)
class _Patches:
    """Pixels of one view with the pixels around them."""

    origin_world: Float64[np.ndarray, "3"]
    directions_world: Float64[np.ndarray, "n o 3"]
    depth_factors: Float64[np.ndarray, "n o"]
    rgb_srgb: Float32[np.ndarray, "n o 3"]
    y: Int64[np.ndarray, " n"]
    x: Int64[np.ndarray, " n"]


def dense_points(
    dataset: Dataset,
    count: int,
    rng: np.random.Generator,
    *,
    threads: int = 1,
    behind: FirstBackground | None = None,
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]:
    """About ``count`` points or fewer, and their display colours, beside those of the sparse model.

    The sparse model must have points. Masked and transparent pixels, and those that show what is ``behind``
    everything, give none. ``threads`` work on the views side by side, which changes no point.
    """
    known = dataset.points.xyz_world.astype(np.float64)
    neighbours = _neighbouring_views(dataset, known)
    points, colours = [np.empty((0, 3), np.float32)], [np.empty((0, 3), np.float32)]
    for round_number in range(ROUNDS):
        # Pixels that no guess fits are lost: draw some more.
        wanted = round(1.6 * (count - sum(map(len, points))) / (ROUNDS - round_number))
        per_view = rng.multinomial(max(0, wanted), _areas(dataset))
        generators = rng.spawn(len(per_view))  # one a view, so that their order does not matter
        jobs = list(zip(dataset.train_indices.tolist(), per_view.tolist(), generators, strict=True))

        def lift(
            job: tuple[int, int, np.random.Generator], known: np.ndarray = known
        ) -> tuple[np.ndarray, ...]:
            index, samples, generator = job
            return _lift(dataset, index, samples, known, neighbours[index], generator, behind)

        with ThreadPoolExecutor(threads) as pool:
            found, seen = map(np.concatenate, zip(*pool.map(lift, jobs), strict=True))
            kept = _elected(dataset, found, seen, pool)
        points.append(found[kept])
        colours.append(seen[kept])
        known = np.concatenate([known, points[-1]])
    xyz, rgb = np.concatenate(points), np.concatenate(colours)
    if len(xyz) > count:
        keep = np.sort(rng.choice(len(xyz), count, replace=False))
        xyz, rgb = xyz[keep], rgb[keep]
    return xyz, rgb


def _areas(dataset: Dataset) -> Float64[np.ndarray, " t"]:
    areas = np.array(
        [dataset.views[i].width_px * dataset.views[i].height_px for i in dataset.train_indices], np.float64
    )
    return areas / areas.sum()


def _neighbouring_views(dataset: Dataset, points: Float64[np.ndarray, "n 3"]) -> dict[int, list[int]]:
    """Of each training view, the nearest others that look about the same way from another place."""
    train = [int(i) for i in dataset.train_indices]
    centres = np.stack([dataset.views[i].origin_world for i in train])
    axes = np.stack([dataset.views[i].rotation_cam_from_world[2] for i in train])
    middle = np.median(points, axis=0)
    result = {}
    for k, index in enumerate(train):
        distance = np.linalg.norm(centres - centres[k], axis=1)
        wanted = BASELINE * np.linalg.norm(middle - centres[k])
        usable = (axes @ axes[k] > LEAST_COSINE) & (distance > 0.1 * wanted)
        unfit = np.abs(np.log(np.maximum(distance, 1e-12) / max(wanted, 1e-12)))
        order = np.argsort(np.where(usable, unfit, np.inf), kind="stable")
        result[index] = [train[j] for j in order[:NEIGHBOURS] if usable[j]]
    return result


def _lift(
    dataset: Dataset,
    index: int,
    samples: int,
    points: Float64[np.ndarray, "k 3"],
    neighbours: list[int],
    rng: np.random.Generator,
    behind: FirstBackground | None,
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]:
    """Points for random pixels of one view."""
    nothing = np.empty((0, 3), np.float32)
    projected_px, depths = _project(dataset, index, points)
    inside = _inside(dataset, index, projected_px) & (depths > 0)
    if samples == 0 or not neighbours or inside.sum() < GUESSES:
        return nothing, nothing
    patches = _draw(dataset, index, samples, rng)
    if len(patches.y) == 0:
        return nothing, nothing
    pixels_px = np.stack([patches.x + 0.5, patches.y + 0.5], axis=1)
    _, nearest = cKDTree(projected_px[inside]).query(pixels_px, GUESSES)
    guesses = depths[inside][nearest]
    costs = np.stack([_cost(dataset, patches, guesses[:, g], neighbours) for g in range(GUESSES)], axis=1)
    best = np.argmin(costs, axis=1)
    rows = np.arange(len(best))
    good = costs[rows, best] < MAX_COST
    if behind is not None:
        at_infinity = _cost(dataset, patches, np.full(len(rows), INFINITY * guesses.max()), neighbours)
        as_well = at_infinity < costs[rows, best] + AS_WELL
        good &= ~(as_well & behind.may_show(patches.directions_world[:, 0]))
    distance = guesses[rows, best] * patches.depth_factors[:, 0]
    xyz = patches.origin_world + distance[:, None] * patches.directions_world[:, 0]
    return xyz[good].astype(np.float32), patches.rgb_srgb[good, 0]


def _draw(dataset: Dataset, index: int, samples: int, rng: np.random.Generator) -> _Patches:
    """Random pixels that count, away from the border, with those around them."""
    view = dataset.views[index]
    y = rng.integers(STEP_PX, max(STEP_PX + 1, view.height_px - STEP_PX), samples)
    x = rng.integers(STEP_PX, max(STEP_PX + 1, view.width_px - STEP_PX), samples)
    all_y = np.clip(y[:, None] + OFFSETS_PX[:, 1], 0, view.height_px - 1)
    all_x = np.clip(x[:, None] + OFFSETS_PX[:, 0], 0, view.width_px - 1)
    which = np.full(all_y.size, index)
    rays = dataset.rays(which, all_y.reshape(-1), all_x.reshape(-1))
    origins, directions = rays.origins_world, rays.directions_world
    rgb, alpha, weight = dataset.pixels(which, all_y.reshape(-1), all_x.reshape(-1))
    counts = ((weight > 0) & (alpha > 0.5)).reshape(all_y.shape).all(axis=1)
    directions = directions.astype(np.float64).reshape(*all_y.shape, 3)
    # Distance along a ray of a point at depth 1 along the camera's axis.
    factors = 1.0 / np.maximum(directions @ view.rotation_cam_from_world[2], 1e-3)
    return _Patches(
        origins[0].astype(np.float64),
        directions[counts],
        factors[counts],
        rgb.reshape(*all_y.shape, 3)[counts],
        y[counts],
        x[counts],
    )


def _cost(
    dataset: Dataset, patches: _Patches, depths: Float64[np.ndarray, " n"], neighbours: list[int]
) -> Float64[np.ndarray, " n"]:
    """How much the patches, moved to the given depths, differ from what the neighbouring views show there."""
    distances = depths[:, None] * patches.depth_factors
    points = patches.origin_world + distances[:, :, None] * patches.directions_world
    count, offsets = distances.shape
    costs = np.full((len(neighbours), count), np.inf)
    own = patches.rgb_srgb - patches.rgb_srgb.mean(axis=1, keepdims=True)
    for k, other in enumerate(neighbours):
        where_px, depth = _project(dataset, other, points.reshape(-1, 3))
        inside = (_inside(dataset, other, where_px) & (depth > 0)).reshape(count, offsets).all(axis=1)
        if not inside.any():
            continue
        chosen = np.floor(where_px.reshape(count, offsets, 2)[inside]).astype(np.int64).reshape(-1, 2)
        rgb, _, _ = dataset.pixels(np.full(len(chosen), other), chosen[:, 1], chosen[:, 0])
        theirs = rgb.reshape(-1, offsets, 3)
        level = np.abs(theirs.mean(axis=1) - patches.rgb_srgb[inside].mean(axis=1)).mean(axis=1)
        texture = np.abs(theirs - theirs.mean(axis=1, keepdims=True) - own[inside]).mean(axis=(1, 2))
        costs[k, inside] = texture + LEVEL_WEIGHT * level
    costs.sort(axis=0)
    used = costs[: max(1, (len(neighbours) + 1) // 2)]
    return np.asarray(used.mean(axis=0))


def _elected(
    dataset: Dataset,
    xyz_world: Float32[np.ndarray, "n 3"],
    rgb_srgb: Float32[np.ndarray, "n 3"],
    pool: ThreadPoolExecutor,
) -> Bool[np.ndarray, " n"]:
    """Whether enough of the views that look towards each point show its colour there."""
    agree, looking = np.zeros(len(xyz_world), np.int64), np.zeros(len(xyz_world), np.int64)
    train = dataset.train_indices

    def vote(index: int) -> tuple[np.ndarray, np.ndarray]:
        where_px, depth = _project(dataset, index, xyz_world.astype(np.float64))
        inside = np.flatnonzero(_inside(dataset, index, where_px) & (depth > 0))
        pixel = np.floor(where_px[inside]).astype(np.int64)
        rgb, _, _ = dataset.pixels(np.full(len(inside), index), pixel[:, 1], pixel[:, 0])
        return inside, np.abs(rgb - rgb_srgb[inside]).mean(axis=1) < AGREES

    jury = train[np.unique(np.linspace(0, len(train) - 1, JURY).astype(np.int64))].tolist()
    for inside, agrees in pool.map(vote, jury):
        looking[inside] += 1
        agree[inside] += agrees
    return np.asarray(agree >= MAJORITY * np.maximum(looking, 1))


def _project(
    dataset: Dataset, index: int, points: Float64[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, " n"]]:
    """Image points, pixels, and depths along the axis of one view."""
    view = dataset.views[index]
    points_cam = points @ view.rotation_cam_from_world.T + view.translation_cam_from_world
    return dataset.cameras[view.camera_index].project(points_cam), points_cam[:, 2]


def _inside(dataset: Dataset, index: int, where_px: Float64[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    view = dataset.views[index]
    with np.errstate(invalid="ignore"):
        return np.asarray(((where_px >= 0) & (where_px < [view.width_px, view.height_px])).all(axis=1))
