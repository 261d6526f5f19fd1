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

import numpy as np
from jaxtyping import Float32, Float64
from scipy.spatial import cKDTree

from octasplat.engine.dataset import Dataset
from octasplat.engine.train.initialization.initial_background import InitialBackground
from octasplat.engine.train.initialization.patch_matching import (
    ExposedPhotographs,
    draw_patches,
    is_inside,
    patch_costs,
    project,
)
from octasplat.engine.train.initialization.plane_sweep_points import (
    MatchEvidence,
    PlaneSweepPoints,
    is_confirmed,
)
from octasplat.engine.train.initialization.visibility_vote import passes_vote
from octasplat.engine.train.sampling.pixel_sampler import valid_pixel_fraction

DEPTH_HYPOTHESES = 6
"""Depths tried for a pixel: those of the nearest points in the image."""
NEIGHBOURS = 4
"""Views in which a guess is judged; the better half of them counts, since the rest may be hidden."""
ROUNDS = 3
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
"""Mean difference of color, in display values, above which no guess counts as right."""
BACKGROUND_COST_MARGIN = 0.005
"""A pixel that matches infinitely far away about as well as at any guess shows the sky."""
BACKGROUND_DEPTH = 1e6
"""So many times the largest depth."""
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
OCCLUSION_FACTOR = 1.2
"""Such points beyond so many times the depth that others suggest are wrong: something nearer was known."""


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
    """Return about ``count`` points or fewer beside those of the sparse model.

    Args:
        dataset: the photographs; the sparse model must have points. Masked and transparent pixels give none.
        count: points wanted.
        rng: draws the pixels.
        threads: work on the views side by side, which changes no point.
        background: what is behind everything; pixels that show it give no points.
        gains: factors on the display colors of each view, after which all are exposed alike; None for 1.
        unseen: whether pixels whose place no two neighbouring views show, so that nothing can be matched, are
            lifted, too: to a depth between those of the points around.
    """
    photographs = ExposedPhotographs(dataset, gains)
    known = dataset.points.xyz_world.astype(np.float64)
    neighbours = _neighbouring_views(dataset, known)
    lifted = PlaneSweepPoints.concatenate([])
    samples_per_point = min(SAMPLES_PER_POINT / valid_pixel_fraction(dataset), MAX_SAMPLES_PER_POINT)
    for round_number in range(ROUNDS):
        # Pixels that no guess fits are lost, and those that show nothing: draw some more.
        pixel_count = round(samples_per_point * (count - len(lifted)) / (ROUNDS - round_number))
        per_view = rng.multinomial(max(0, pixel_count), _view_areas(dataset))
        generators = rng.spawn(len(per_view))  # one a view, so that their order does not matter
        jobs = list(zip(dataset.train_indices.tolist(), per_view.tolist(), generators, strict=True))

        def lift(
            job: tuple[int, int, np.random.Generator], known: np.ndarray = known
        ) -> tuple[PlaneSweepPoints, MatchEvidence]:
            index, samples, generator = job
            return _lift_pixels(
                photographs=photographs,
                index=index,
                samples=samples,
                points=known,
                neighbours=neighbours[index],
                rng=generator,
                background=background,
                unseen=unseen,
            )

        with ThreadPoolExecutor(threads) as pool:
            parts = list(pool.map(lift, jobs))
            candidates = PlaneSweepPoints.concatenate([points for points, _ in parts])
            evidence = MatchEvidence.concatenate([e for _, e in parts])
            is_elected = passes_vote(photographs, candidates, evidence.view, pool)
        candidates, evidence = candidates[is_elected], evidence[is_elected]
        candidates = candidates[~candidates.swept | is_confirmed(candidates, evidence, known)]
        lifted = PlaneSweepPoints.concatenate([lifted, candidates])
        known = np.concatenate([known, candidates.xyz_world])
    if len(lifted) > count:
        lifted = lifted[np.sort(rng.choice(len(lifted), count, replace=False))]
    return lifted


def _view_areas(dataset: Dataset) -> Float64[np.ndarray, " t"]:
    areas = np.array(
        [dataset.views[i].width_px * dataset.views[i].height_px for i in dataset.train_indices], np.float64
    )
    return areas / areas.sum()


def _neighbouring_views(dataset: Dataset, points: Float64[np.ndarray, "n 3"]) -> dict[int, list[int]]:
    """Return for each training view the nearest others that look about the same way from another place."""
    train = [int(i) for i in dataset.train_indices]
    centres = np.stack([dataset.views[i].origin_world for i in train])
    axes = np.stack([dataset.views[i].rotation_cam_from_world[2] for i in train])
    middle = np.median(points, axis=0)
    observed_distances = _observed_distances(dataset)
    result = {}
    for k, index in enumerate(train):
        distance = np.linalg.norm(centres - centres[k], axis=1)
        scene_distance = float(np.linalg.norm(middle - centres[k]))
        if observed_distances[index] > 0:
            scene_distance = min(
                max(scene_distance, observed_distances[index] / OBSERVED_SPAN),
                observed_distances[index] * OBSERVED_SPAN,
            )
        baseline = BASELINE * scene_distance
        # views from one place tell no depth
        usable = (axes @ axes[k] > MIN_VIEW_COSINE) & (distance > 0.1 * baseline)
        baseline_error = np.abs(np.log(np.maximum(distance, 1e-12) / max(baseline, 1e-12)))
        # stable, so that equal views are chosen alike everywhere
        order = np.argsort(np.where(usable, baseline_error, np.inf), kind="stable")
        result[index] = [train[j] for j in order[:NEIGHBOURS] if usable[j]]
    return result


def _observed_distances(dataset: Dataset) -> Float64[np.ndarray, " v"]:
    """Return the median distance of the points that each view is known to show; 0 where these are few."""
    result = np.zeros(len(dataset.views))
    observations, points = dataset.observations, dataset.points
    if len(points) == 0 or len(observations) == 0:
        return result
    row, known = points.rows_of(observations.point)
    origins = np.stack([view.origin_world for view in dataset.views])
    all_distances = np.linalg.norm(
        points.xyz_world[row].astype(np.float64) - origins[observations.view], axis=1
    )
    for index in range(len(result)):
        distances = all_distances[known & (observations.view == index)]
        if len(distances) >= MIN_OBSERVED:
            result[index] = np.median(distances)
    return result


def _lift_pixels(
    photographs: ExposedPhotographs,
    index: int,
    samples: int,
    points: Float64[np.ndarray, "k 3"],
    neighbours: list[int],
    rng: np.random.Generator,
    background: InitialBackground | None,
    unseen: bool,
) -> tuple[PlaneSweepPoints, MatchEvidence]:
    """Return points for random pixels of one view."""
    dataset = photographs.dataset
    no_points = (
        PlaneSweepPoints.concatenate([]),
        MatchEvidence(np.empty(0, np.int64), np.empty(0), np.empty(0)),
    )
    projected_px, depths = project(dataset, index, points)
    inside = is_inside(dataset, index, projected_px) & (depths > 0)
    if samples == 0 or not neighbours or inside.sum() < DEPTH_HYPOTHESES:
        return no_points
    patches = draw_patches(photographs, index, samples, rng)
    if len(patches.y) == 0:
        return no_points
    pixels_px = np.stack([patches.x + 0.5, patches.y + 0.5], axis=1)
    distances_px, nearest = cKDTree(projected_px[inside]).query(pixels_px, DEPTH_HYPOTHESES)
    suggested = depths[inside][nearest]
    depth, cost = _best_hypothesis(suggested, patch_costs(photographs, patches, suggested, neighbours))
    # --- badly matched pixels: depths that no point suggests ---
    doubtful = np.flatnonzero(cost > MAX_AMBIGUOUS_COST)
    more = _trial_depths(depths[inside], len(doubtful), rng)
    more_costs = patch_costs(photographs, patches[doubtful], more, neighbours)
    other, other_cost = _best_hypothesis(more, more_costs)
    swept = np.zeros(len(depth), np.bool_)
    swept[doubtful] = other_cost < MAX_RIVALRY * np.minimum(cost[doubtful], MAX_COST)
    chosen = swept[doubtful]  # among the doubtful ones
    is_kept = cost < MAX_COST
    is_kept[swept] = other[chosen] < OCCLUSION_FACTOR * depth[swept]
    depth[swept], cost[swept] = other[chosen], other_cost[chosen]
    rivalry = np.ones(len(depth))
    rivalry[swept] = _cost_ratio(more_costs[chosen])
    is_unmatched = np.isinf(cost) & unseen
    depth[is_unmatched] = _interpolate_depths(suggested[is_unmatched], distances_px[is_unmatched])
    is_kept |= is_unmatched
    if background is not None:
        # --- pixels that match at infinity: the background ---
        infinity = np.full((len(depth), 1), BACKGROUND_DEPTH * depth.max())
        at_infinity = patch_costs(photographs, patches, infinity, neighbours)[:, 0]
        is_background = is_unmatched | (at_infinity < cost + BACKGROUND_COST_MARGIN)
        is_kept &= ~(is_background & background.is_above_horizon(patches.directions_world[:, 0]))
    distance = depth * patches.depth_factors[:, 0]
    xyz = patches.origin_world + distance[:, None] * patches.directions_world[:, 0]
    lifted = PlaneSweepPoints(xyz.astype(np.float32), patches.rgb_srgb[:, 0], swept)
    return lifted[is_kept], MatchEvidence(np.full(len(depth), index), distance, rivalry)[is_kept]


def _best_hypothesis(
    guesses: Float64[np.ndarray, "n g"], costs: Float64[np.ndarray, "n g"]
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Return the depth of each patch that matches best, and its cost."""
    best = np.argmin(costs, axis=1)[:, None]
    return np.take_along_axis(guesses, best, 1)[:, 0], np.take_along_axis(costs, best, 1)[:, 0]


def _cost_ratio(costs: Float64[np.ndarray, "n g"]) -> Float64[np.ndarray, " n"]:
    """Return the least cost over the next that is more than one step away; depths are in order."""
    best = np.argmin(costs, axis=1)[:, None]
    # neighboring depths are moved versions of the same match
    is_neighbor = np.abs(np.arange(costs.shape[1]) - best) <= 1
    return np.asarray(costs.min(axis=1) / np.maximum(np.where(is_neighbor, np.inf, costs).min(axis=1), 1e-12))


def _interpolate_depths(
    depths: Float64[np.ndarray, "n g"], away_px: Float64[np.ndarray, "n g"]
) -> Float64[np.ndarray, " n"]:
    """Return mean depths, in logarithms, weighted by the inverse of the squared distance in the image."""
    weights = 1.0 / (away_px + 1.0) ** 2
    return np.asarray(np.exp((weights * np.log(depths)).sum(axis=1) / weights.sum(axis=1)))


def _trial_depths(
    depths: Float64[np.ndarray, " k"], count: int, rng: np.random.Generator
) -> Float64[np.ndarray, "n g"]:
    """Return depths to try for ``count`` pixels of a view whose points lie at ``depths``."""
    ordered = np.sort(depths)
    near = NEAR_FACTOR * ordered[min(NEAR_RANK, len(ordered) - 1)]
    far = FAR_FACTOR * ordered[int(FAR_QUANTILE * (len(ordered) - 1))]
    steps = (np.arange(SWEEP_DEPTHS) + rng.random((count, SWEEP_DEPTHS))) / SWEEP_DEPTHS
    return np.asarray(near * (far / near) ** steps)
