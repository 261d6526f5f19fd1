"""More points to begin from: pixels lifted to the depth at which neighbouring photographs agree.

Structure from motion leaves plain walls, floors and leaves almost empty, and growth needs thousands of
iterations to carry Gaussians there. Here random pixels of the training views take the depths of the points
seen around them as guesses; each guess is judged by how well a small patch, moved into neighbouring views,
matches what they show. What agrees becomes a point, and serves as a guess in the next round.

A twig before a house has no sparse points around it but the house's. Pixels that match badly at these depths
are therefore tried at others, from near to far. More of what is found so is wrong, as one of many depths soon
matches by chance, most of all where neighbouring photographs are far apart. Such points need more views that
agree; they count where known points lie close by, or where pixels of other views found the same place and no
other depth matches about as well; and they are marked, so that they can begin as small Gaussians, which hide
little.

A plane sweep on a few planes a pixel, after "A Space-Sweep Approach to True Multi-Image Matching"
(https://doi.org/10.1109/CVPR.1996.517097).
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from scipy.spatial import cKDTree

from octasplat.engine.dataset import Dataset
from octasplat.engine.train.initialization.initial_background import InitialBackground
from octasplat.engine.train.initialization.plane_sweep_points import (
    MatchEvidence,
    PlaneSweepPoints,
    is_confirmed,
)
from octasplat.engine.train.kernels.patch_costs import patch_differences
from octasplat.engine.train.sampling.shown import valid_pixel_fraction

DEPTH_HYPOTHESES = 6
"""Depths tried for a pixel: those of the nearest points in the image."""
NEIGHBOURS = 4
"""Views in which a guess is judged; the better half of them counts, since the rest may be hidden."""
ROUNDS = 3
STEP_PX = 2
OFFSETS_PX = STEP_PX * np.array([[x, y] for x in (0, 1, -1) for y in (0, 1, -1)], np.int64)
SWEEP_DEPTHS = 24
"""Depths that are tried besides, in equal ratios from near to far, each moved at random within its step."""
MAX_AMBIGUOUS_COST = 0.01
"""Pixels that match better than that at the depth of a point are not tried at others."""
MAX_RIVALRY = 0.7
"""A depth that no point suggests must match so much better."""
NEAR_RANK, NEAR_FACTOR = 10, 0.7
"""The sweep begins at this share of the depth of so many nearest points, of which fewer may be wrong."""
FAR_QUANTILE, FAR_FACTOR = 0.98, 1.5
"""It ends at so many times the depth that this share of the points lies before."""
MAX_COST = 0.06
"""Mean difference of colour, in display values, above which no guess counts as right."""
BACKGROUND_COST_MARGIN = 0.005
"""A pixel that matches infinitely far away about as well as at any guess shows the sky."""
BACKGROUND_DEPTH = 1e6
"""So many times the largest depth."""
LEVEL_WEIGHT = 0.3
"""Weight of a difference in brightness against one in texture."""
MIN_VIEW_COSINE = 0.5
"""Neighbouring views look less than 60 degrees another way."""
BASELINE = 0.05
"""Distance of a good neighbouring view, of that to the points: less tells depths badly apart, more shows
other things."""
SAMPLES_PER_POINT, MAX_SAMPLES_PER_POINT = 1.6, 10.0
"""Pixels that show something are drawn for each point; and at the most, with those that show nothing."""
OBSERVED_SPAN, MIN_OBSERVED = 4.0, 10
"""The points are taken to be as far from a view as their middle is, but within this factor of the median
distance of those that it is known to show, if these are so many: a long capture has its middle anywhere.
"""
VOTING_VIEWS = 24
"""Views that vote on each point, spread evenly over all, or nearest to its own where few of these look."""
MIN_VOTERS = 3
"""Jurors that must look towards a point."""
MAX_VOTE_DIFFERENCE = 0.12
"""Largest mean difference of colour, in display values, of a view that agrees."""
MIN_VOTE_FRACTION = 0.3
"""Share of the views looking there that must agree: a point in free space hides other things in most."""
SWEEP_MAX_VOTE_DIFFERENCE, SWEEP_MIN_VOTE_FRACTION = 0.1, 0.4
"""The same of points at depths that no other point suggested."""
OCCLUSION_FACTOR = 1.2
"""Such points beyond so many times the depth that others suggest are wrong: something nearer was known."""


@dataclass(frozen=True)
class _Photographs:
    """The photographs as if all were exposed alike."""

    dataset: Dataset
    gains: Float32[np.ndarray, " v"] | None

    def pixels(
        self, view: Int64[np.ndarray, " r"], y: Int64[np.ndarray, " r"], x: Int64[np.ndarray, " r"]
    ) -> tuple[Float32[np.ndarray, "r 3"], Float32[np.ndarray, " r"], Float32[np.ndarray, " r"]]:
        """Straight display colour, alpha and weight of pixels."""
        rgb, alpha, weight = self.dataset.pixels(view, y, x)
        if self.gains is not None:
            rgb = np.clip(rgb * self.gains[view][:, None], 0, 1)
        return rgb, alpha, weight


@dataclass(frozen=True)
class _Patches:
    """Pixels of one view with the pixels around them."""

    origin_world: Float64[np.ndarray, "3"]
    directions_world: Float64[np.ndarray, "n o 3"]
    depth_factors: Float64[np.ndarray, "n o"]
    rgb_srgb: Float32[np.ndarray, "n o 3"]
    y: Int64[np.ndarray, " n"]
    x: Int64[np.ndarray, " n"]

    def __getitem__(self, which: Int64[np.ndarray, " k"]) -> "_Patches":
        origin, *rows = vars(self).values()
        return _Patches(origin, *(row[which] for row in rows))


def plane_sweep_points(
    dataset: Dataset,
    count: int,
    rng: np.random.Generator,
    *,
    threads: int = 1,
    background: InitialBackground | None = None,
    gains: Float32[np.ndarray, " v"] | None = None,
    unseen: bool = False,
) -> PlaneSweepPoints:
    """About ``count`` points or fewer beside those of the sparse model.

    Args:
        dataset: the photographs; the sparse model must have points. Masked and transparent pixels give none.
        count: points wanted.
        rng: draws the pixels.
        threads: work on the views side by side, which changes no point.
        background: what is behind everything; pixels that show it give no points.
        gains: factors on the display colours of each view, after which all are exposed alike; None for 1.
        unseen: whether pixels whose place no two neighbouring views show, so that nothing can be matched, are
            lifted, too: to a depth between those of the points around.
    """
    photographs = _Photographs(dataset, gains)
    known = dataset.points.xyz_world.astype(np.float64)
    neighbours = _neighbouring_views(dataset, known)
    lifted = PlaneSweepPoints.concatenate([])
    for_one = min(SAMPLES_PER_POINT / valid_pixel_fraction(dataset), MAX_SAMPLES_PER_POINT)
    for round_number in range(ROUNDS):
        # Pixels that no guess fits are lost, and those that show nothing: draw some more.
        wanted = round(for_one * (count - len(lifted)) / (ROUNDS - round_number))
        per_view = rng.multinomial(max(0, wanted), _view_areas(dataset))
        generators = rng.spawn(len(per_view))  # one a view, so that their order does not matter
        jobs = list(zip(dataset.train_indices.tolist(), per_view.tolist(), generators, strict=True))

        def lift(
            job: tuple[int, int, np.random.Generator], known: np.ndarray = known
        ) -> tuple[PlaneSweepPoints, MatchEvidence]:
            index, samples, generator = job
            return _lift_pixels(
                photographs, index, samples, known, neighbours[index], generator, background, unseen
            )

        with ThreadPoolExecutor(threads) as pool:
            parts = list(pool.map(lift, jobs))
            found = PlaneSweepPoints.concatenate([points for points, _ in parts])
            evidence = MatchEvidence.concatenate([e for _, e in parts])
            elected = _passes_vote(photographs, found, evidence.view, pool)
        found, evidence = found[elected], evidence[elected]
        found = found[~found.swept | is_confirmed(found, evidence, known)]
        lifted = PlaneSweepPoints.concatenate([lifted, found])
        known = np.concatenate([known, found.xyz_world])
    if len(lifted) > count:
        lifted = lifted[np.sort(rng.choice(len(lifted), count, replace=False))]
    return lifted


def _view_areas(dataset: Dataset) -> Float64[np.ndarray, " t"]:
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
    own = _observed_distances(dataset)
    result = {}
    for k, index in enumerate(train):
        distance = np.linalg.norm(centres - centres[k], axis=1)
        reach = float(np.linalg.norm(middle - centres[k]))
        if own[index] > 0:
            reach = min(max(reach, own[index] / OBSERVED_SPAN), own[index] * OBSERVED_SPAN)
        wanted = BASELINE * reach
        usable = (axes @ axes[k] > MIN_VIEW_COSINE) & (distance > 0.1 * wanted)
        unfit = np.abs(np.log(np.maximum(distance, 1e-12) / max(wanted, 1e-12)))
        order = np.argsort(np.where(usable, unfit, np.inf), kind="stable")
        result[index] = [train[j] for j in order[:NEIGHBOURS] if usable[j]]
    return result


def _observed_distances(dataset: Dataset) -> Float64[np.ndarray, " v"]:
    """Return the median distance of the points that each view is known to show; 0 where these are few."""
    result = np.zeros(len(dataset.views))
    seen, points = dataset.observations, dataset.points
    if len(points) == 0 or len(seen) == 0:
        return result
    row = np.minimum(np.searchsorted(points.ids, seen.point), len(points) - 1)
    known = points.ids[row] == seen.point
    origins = np.stack([view.origin_world for view in dataset.views])
    away = np.linalg.norm(points.xyz_world[row].astype(np.float64) - origins[seen.view], axis=1)
    for index in range(len(result)):
        own = away[known & (seen.view == index)]
        if len(own) >= MIN_OBSERVED:
            result[index] = np.median(own)
    return result


def _lift_pixels(
    photographs: _Photographs,
    index: int,
    samples: int,
    points: Float64[np.ndarray, "k 3"],
    neighbours: list[int],
    rng: np.random.Generator,
    behind: InitialBackground | None,
    unseen: bool,
) -> tuple[PlaneSweepPoints, MatchEvidence]:
    """Points for random pixels of one view."""
    dataset = photographs.dataset
    nothing = PlaneSweepPoints.concatenate([]), MatchEvidence(np.empty(0, np.int64), np.empty(0), np.empty(0))
    projected_px, depths = _project(dataset, index, points)
    inside = _is_inside(dataset, index, projected_px) & (depths > 0)
    if samples == 0 or not neighbours or inside.sum() < DEPTH_HYPOTHESES:
        return nothing
    patches = _draw_patches(photographs, index, samples, rng)
    if len(patches.y) == 0:
        return nothing
    pixels_px = np.stack([patches.x + 0.5, patches.y + 0.5], axis=1)
    away_px, nearest = cKDTree(projected_px[inside]).query(pixels_px, DEPTH_HYPOTHESES)
    suggested = depths[inside][nearest]
    depth, cost = _best_hypothesis(suggested, _hypothesis_costs(photographs, patches, suggested, neighbours))
    doubtful = np.flatnonzero(cost > MAX_AMBIGUOUS_COST)
    more = _sweep(depths[inside], len(doubtful), rng)
    more_costs = _hypothesis_costs(photographs, patches[doubtful], more, neighbours)
    other, other_cost = _best_hypothesis(more, more_costs)
    swept = np.zeros(len(depth), np.bool_)
    swept[doubtful] = other_cost < MAX_RIVALRY * np.minimum(cost[doubtful], MAX_COST)
    chosen = swept[doubtful]
    good = cost < MAX_COST
    good[swept] = other[chosen] < OCCLUSION_FACTOR * depth[swept]
    depth[swept], cost[swept] = other[chosen], other_cost[chosen]
    rivalry = np.ones(len(depth))
    rivalry[swept] = _cost_ratio(more_costs[chosen])
    alone = np.isinf(cost) & unseen
    depth[alone] = _interpolate_depths(suggested[alone], away_px[alone])
    good |= alone
    if behind is not None:
        at_infinity = _cost(
            photographs, patches, np.full(len(depth), BACKGROUND_DEPTH * depth.max()), neighbours
        )
        as_well = alone | (at_infinity < cost + BACKGROUND_COST_MARGIN)
        good &= ~(as_well & behind.is_above_horizon(patches.directions_world[:, 0]))
    distance = depth * patches.depth_factors[:, 0]
    xyz = patches.origin_world + distance[:, None] * patches.directions_world[:, 0]
    lifted = PlaneSweepPoints(xyz.astype(np.float32), patches.rgb_srgb[:, 0], swept)
    return lifted[good], MatchEvidence(np.full(len(depth), index), distance, rivalry)[good]


def _hypothesis_costs(
    photographs: _Photographs,
    patches: _Patches,
    guesses: Float64[np.ndarray, "n g"],
    neighbours: list[int],
) -> Float64[np.ndarray, "n g"]:
    """How much each patch at each of its guesses differs from what the neighbours show."""
    return np.stack([_cost(photographs, patches, guess, neighbours) for guess in guesses.T], axis=1)


def _best_hypothesis(
    guesses: Float64[np.ndarray, "n g"], costs: Float64[np.ndarray, "n g"]
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """The guess of each patch that matches best, and its cost."""
    best = np.argmin(costs, axis=1)[:, None]
    return np.take_along_axis(guesses, best, 1)[:, 0], np.take_along_axis(costs, best, 1)[:, 0]


def _cost_ratio(costs: Float64[np.ndarray, "n g"]) -> Float64[np.ndarray, " n"]:
    """The least cost over the next that is more than one step away; depths are in order."""
    best = np.argmin(costs, axis=1)[:, None]
    beside = np.abs(np.arange(costs.shape[1]) - best) <= 1
    return np.asarray(costs.min(axis=1) / np.maximum(np.where(beside, np.inf, costs).min(axis=1), 1e-12))


def _interpolate_depths(
    depths: Float64[np.ndarray, "n g"], away_px: Float64[np.ndarray, "n g"]
) -> Float64[np.ndarray, " n"]:
    """Mean depths, in logarithms, weighted by the inverse of the squared distance in the image."""
    weights = 1.0 / (away_px + 1.0) ** 2
    return np.asarray(np.exp((weights * np.log(depths)).sum(axis=1) / weights.sum(axis=1)))


def _sweep(
    depths: Float64[np.ndarray, " k"], count: int, rng: np.random.Generator
) -> Float64[np.ndarray, "n g"]:
    """Depths for ``count`` pixels of a view whose points lie at ``depths``."""
    ordered = np.sort(depths)
    near = NEAR_FACTOR * ordered[min(NEAR_RANK, len(ordered) - 1)]
    far = FAR_FACTOR * ordered[int(FAR_QUANTILE * (len(ordered) - 1))]
    steps = (np.arange(SWEEP_DEPTHS) + rng.random((count, SWEEP_DEPTHS))) / SWEEP_DEPTHS
    return np.asarray(near * (far / near) ** steps)


def _draw_patches(photographs: _Photographs, index: int, samples: int, rng: np.random.Generator) -> _Patches:
    """Random pixels that count, away from the border, with those around them."""
    dataset = photographs.dataset
    view = dataset.views[index]
    y = rng.integers(STEP_PX, max(STEP_PX + 1, view.height_px - STEP_PX), samples)
    x = rng.integers(STEP_PX, max(STEP_PX + 1, view.width_px - STEP_PX), samples)
    all_y = np.clip(y[:, None] + OFFSETS_PX[:, 1], 0, view.height_px - 1)
    all_x = np.clip(x[:, None] + OFFSETS_PX[:, 0], 0, view.width_px - 1)
    which = np.full(all_y.size, index)
    rays = dataset.rays(which, all_y.reshape(-1), all_x.reshape(-1))
    origins, directions = rays.origins_world, rays.directions_world
    rgb, alpha, weight = photographs.pixels(which, all_y.reshape(-1), all_x.reshape(-1))
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
    photographs: _Photographs, patches: _Patches, depths: Float64[np.ndarray, " n"], neighbours: list[int]
) -> Float64[np.ndarray, " n"]:
    """How much the patches, moved to the given depths, differ from what the neighbouring views show there."""
    dataset = photographs.dataset
    distances = depths[:, None] * patches.depth_factors
    points = patches.origin_world + distances[:, :, None] * patches.directions_world
    count, offsets = distances.shape
    costs = np.full((len(neighbours), count), np.inf)
    for k, other in enumerate(neighbours):
        where_px, depth = _project(dataset, other, points.reshape(-1, 3))
        shown = (_is_inside(dataset, other, where_px) & (depth > 0)).reshape(count, offsets)
        inside = np.flatnonzero(shown.all(axis=1))
        if not len(inside):
            continue
        chosen = np.floor(where_px.reshape(count, offsets, 2)[inside]).astype(np.int64).reshape(-1, 2)
        rgb, _, _ = photographs.pixels(np.full(len(chosen), other), chosen[:, 1], chosen[:, 0])
        differences = np.empty(len(inside))
        patch_differences(patches.rgb_srgb, rgb.reshape(-1, offsets, 3), inside, LEVEL_WEIGHT, differences)
        costs[k, inside] = differences
    costs.sort(axis=0)
    used = costs[: max(1, (len(neighbours) + 1) // 2)]
    return np.asarray(used.mean(axis=0))


def _passes_vote(
    photographs: _Photographs,
    points: PlaneSweepPoints,
    own_view: Int64[np.ndarray, " n"],
    pool: ThreadPoolExecutor,
) -> Bool[np.ndarray, " n"]:
    """Return whether enough of the views that look towards each point show its colour there."""
    limits = np.where(points.swept, SWEEP_MAX_VOTE_DIFFERENCE, MAX_VOTE_DIFFERENCE)
    majority = np.where(points.swept, SWEEP_MIN_VOTE_FRACTION, MIN_VOTE_FRACTION)
    agree, looking = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
    dataset = photographs.dataset
    train, xyz_world = dataset.train_indices, points.xyz_world.astype(np.float64)

    def vote(juror: tuple[int, np.ndarray | slice]) -> tuple[np.ndarray, np.ndarray]:
        index, rows = juror
        where_px, depth = _project(dataset, index, xyz_world[rows])
        inside = np.flatnonzero(_is_inside(dataset, index, where_px) & (depth > 0))
        pixel = np.floor(where_px[inside]).astype(np.int64)
        rgb, _, _ = photographs.pixels(np.full(len(inside), index), pixel[:, 1], pixel[:, 0])
        which = inside if isinstance(rows, slice) else rows[inside]
        return which, np.abs(rgb - points.rgb_srgb[which]).mean(axis=1) < limits[which]

    jury = train[np.unique(np.linspace(0, len(train) - 1, VOTING_VIEWS).astype(np.int64))].tolist()
    for which, agrees in pool.map(vote, [(index, slice(None)) for index in jury]):
        looking[which] += 1
        agree[which] += agrees
    if len(jury) < len(train):
        unseen = np.flatnonzero(looking < MIN_VOTERS)
        looking[unseen] = agree[unseen] = 0
        for which, agrees in pool.map(vote, _voting_views(dataset, own_view, unseen)):
            looking[which] += 1
            agree[which] += agrees
    return np.asarray(agree >= majority * np.maximum(looking, 1))


def _voting_views(
    dataset: Dataset, own_view: Int64[np.ndarray, " n"], rows: Int64[np.ndarray, " k"]
) -> list[tuple[int, Int64[np.ndarray, "_"]]]:
    """Return training views and the rows of points that they vote on: those of the nearest other views."""
    train = dataset.train_indices
    centres = np.stack([dataset.views[i].origin_world for i in train.tolist()])
    jurors = []
    for index in np.unique(own_view[rows]).tolist():
        away = np.linalg.norm(centres - dataset.views[index].origin_world, axis=1)
        near = train[np.argsort(away, kind="stable")[: VOTING_VIEWS + 1]]
        mine = rows[own_view[rows] == index]
        jurors += [(juror, mine) for juror in near.tolist() if juror != index]
    return jurors


def _project(
    dataset: Dataset, index: int, points: Float64[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, " n"]]:
    """Image points, pixels, and depths along the axis of one view."""
    view = dataset.views[index]
    points_cam = points @ view.rotation_cam_from_world.T + view.translation_cam_from_world
    return dataset.cameras[view.camera_index].project(points_cam), points_cam[:, 2]


def _is_inside(dataset: Dataset, index: int, where_px: Float64[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    view = dataset.views[index]
    x, y = where_px[:, 0], where_px[:, 1]  # what is not-a-number lies nowhere
    with np.errstate(invalid="ignore"):
        return np.asarray((x >= 0) & (y >= 0) & (x < view.width_px) & (y < view.height_px))
