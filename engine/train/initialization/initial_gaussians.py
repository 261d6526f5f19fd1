"""The state before the first iteration, and its Gaussians: on sparse points, or random in the cameras' view.

After "GaMeS: Mesh-Based Adapting and Modification of Gaussian Splatting" (https://arxiv.org/abs/2402.01459),
from which "REdiSplats: Ray Tracing for Editable Gaussian Splatting" (https://arxiv.org/abs/2503.12284,
section 4.2) begins too.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from scipy.spatial import cKDTree

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.region import Region
from octasplat.engine.gaussians.frames import frames_from_normals, quaternions_from_matrices
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians
from octasplat.engine.shading.material_settings import MaterialSettings
from octasplat.engine.shading.recipes import material_shading
from octasplat.engine.train.config import TrainConfig, max_gaussian_count
from octasplat.engine.train.initialization.initial_background import InitialBackground, estimate_background
from octasplat.engine.train.initialization.initial_normals import (
    mean_view_directions,
    plane_normals,
    seen_normals,
)
from octasplat.engine.train.initialization.plane_sweep import plane_sweep_points
from octasplat.engine.train.initialization.plane_sweep_points import PlaneSweepPoints
from octasplat.engine.train.loop.state import TrainState, initial_state
from octasplat.engine.train.sampling.pixel_sampler import valid_pixel_fraction
from octasplat.engine.train.shading_factory import ShadingOptions, find_background, make_shading
from octasplat.engine.train.views.exposure_changes import equalizing_gains

MIN_POINTS = 50
"""Fewer sparse points than this are no use to begin from; random ones are taken."""
NEIGHBOURS = 3
MAX_ANGULAR_SIZE = 0.3
"""Largest scale as seen from the nearest camera, in radians."""
PLANE_SWEEP_MAX_ANGULAR_SIZE = 0.015
"""That of points at depths that no other point suggested: where these are wrong, they hide little."""
MAX_DISTANCE = 50.0
"""Points farther from the cameras than this many extents are matching errors."""


@dataclass(frozen=True)
class InitialGaussianOptions:
    """Number and placement of the Gaussians that a training begins with.

    Attributes:
        seed: of everything random.
        max_count: most Gaussians.
        opacity: that all begin with.
        normal_neighbors: points around one whose plane gives its normal.
        plane_sweep: whether pixels are lifted to their depth where there are fewer sparse points.
        plane_sweep_unseen: whether pixels that no neighbouring view shows are lifted, too.
        equalizes_exposure: whether colors of lifted pixels are compared at equal brightness of the views.
        faces_views: whether normals face the views that observe the points, for shading by one side of them.
    """

    seed: int
    max_count: int
    opacity: float
    normal_neighbors: int
    plane_sweep: bool
    plane_sweep_unseen: bool
    equalizes_exposure: bool
    faces_views: bool = False

    @classmethod
    def from_config(cls, config: TrainConfig, dataset: Dataset) -> "InitialGaussianOptions":
        """Return the options that a configuration asks for with these photographs."""
        max_gaussians = max_gaussian_count(config, dataset.train_pixel_count, valid_pixel_fraction(dataset))
        return cls(
            seed=config.seed,
            max_count=min(config.initial_points, max_gaussians),
            opacity=config.initial_opacity,
            normal_neighbors=config.normal_neighbors,
            plane_sweep=config.plane_sweep_init,
            plane_sweep_unseen=config.plane_sweep_unseen,
            equalizes_exposure=config.exposure is True,
            faces_views=config.materials.learn,
        )


def initial_gaussians(
    dataset: Dataset,
    options: InitialGaussianOptions,
    *,
    threads: int = 1,
    background: InitialBackground | None = None,
) -> FlatGaussians:
    """Return the first Gaussians: on the sparse points, or on random rays where there are too few of them.

    Args:
        dataset: the photographs.
        options: how many, and how they are placed.
        threads: work side by side, which changes nothing that is made.
        background: what lies behind everything; pixels that show it are not lifted.

    Raises:
        DatasetError: nothing says where Gaussians could begin.
    """
    # a stream of its own: 0 is the training's, 1 the probe's
    rng = np.random.Generator(np.random.PCG64([options.seed, 2]))
    limit = options.max_count
    xyz, rgb = dataset.points.xyz_world, dataset.points.rgb_srgb
    if dataset.has_known_distances and len(xyz) < limit:
        lifted = lift_known_pixels(dataset, limit - len(xyz), rng)
        xyz, rgb = np.concatenate([xyz, lifted.xyz_world]), np.concatenate([rgb, lifted.rgb_srgb])
    if len(xyz) >= MIN_POINTS:
        centres = np.stack([dataset.views[i].origin_world for i in dataset.train_indices])
        max_angles = np.full(len(xyz), MAX_ANGULAR_SIZE)
        # a sweep begins at the depths of sparse points
        if options.plane_sweep and len(dataset.points) >= MIN_POINTS and len(xyz) < limit:
            gains = equalizing_gains(dataset) if options.equalizes_exposure else None
            more = plane_sweep_points(
                dataset, limit - len(xyz), rng,
                threads=threads, background=background, gains=gains, unseen=options.plane_sweep_unseen,
            )  # fmt: skip
            xyz, rgb = np.concatenate([xyz, more.xyz_world]), np.concatenate([rgb, more.rgb_srgb])
            max_angles = np.concatenate(
                [max_angles, np.where(more.swept, PLANE_SWEEP_MAX_ANGULAR_SIZE, MAX_ANGULAR_SIZE)]
            )
        return gaussians_from_points(
            xyz,
            rgb,
            centres,
            extent=dataset.extent,
            limit=limit,
            opacity=options.opacity,
            rng=rng,
            plane_points=options.normal_neighbors,
            most_angles=max_angles,
            region=dataset.region,
            seen_from=_seen_from(dataset, len(xyz)) if options.faces_views else None,
        )
    # --- too few sparse points: random pixels at random depths ---
    view, y, x = dataset.sample_pixels(rng, limit)
    rays = dataset.rays(view, y, x)
    rgb, alpha, weight = dataset.pixels(view, y, x)
    is_valid = (weight > 0) & (alpha > 0)
    return gaussians_from_rays(
        rays.origins_world[is_valid],
        rays.directions_world[is_valid],
        rgb[is_valid],
        extent=dataset.extent,
        opacity=options.opacity,
        rng=rng,
    )


def lift_known_pixels(dataset: Dataset, count: int, rng: np.random.Generator) -> PlaneSweepPoints:
    """Return points of pixels of the training views whose distance depth maps tell, at most ``count``.

    Pixels are drawn at random, all of them as likely; those of unknown distance are left out, so that what
    few of them show gets no more points than its share.
    """
    view, y, x = dataset.sample_pixels(rng, count)
    distance = dataset.known_distances(view, y, x)
    rgb, alpha, weight = dataset.pixels(view, y, x)
    known = (distance > 0) & (weight > 0) & (alpha > 0)
    rays = dataset.rays(view[known], y[known], x[known])
    xyz = rays.origins_world + distance[known, None] * rays.directions_world
    return PlaneSweepPoints(xyz.astype(np.float32), rgb[known], np.zeros(len(xyz), np.bool_))


def _seen_from(dataset: Dataset, count: int) -> Float64[np.ndarray, "n 3"]:
    """Return directions to the views of ``count`` points, of which the sparse ones are first; 0 of others."""
    known = mean_view_directions(dataset)
    return np.pad(known, ((0, count - len(known)), (0, 0)))


def add_initial_materials(gaussians: FlatGaussians, settings: MaterialSettings) -> FlatGaussians:
    """Return the same Gaussians with the materials that a training begins with, all alike."""
    first = material_shading(settings.recipe).initial_channels(settings)
    return gaussians.with_channels(
        {name: np.tile(np.array(value, np.float32), (len(gaussians), 1)) for name, value in first.items()}
    )


def initial_train_state(
    dataset: Dataset, config: TrainConfig, *, threads: int = 1, gaussians: FlatGaussians | None = None
) -> TrainState:
    """Return the state with the first Gaussians, their materials and the first background, where learnt.

    Args:
        dataset: the photographs.
        config: all settings of the training.
        threads: work side by side, which changes nothing that is made.
        gaussians: to begin with, with their materials; None makes the first ones.

    Raises:
        DatasetError: nothing says where Gaussians could begin.
    """
    background_map = estimate_background(dataset) if config.background == "learnt" else None
    if gaussians is None:
        options = InitialGaussianOptions.from_config(config, dataset)
        gaussians = initial_gaussians(dataset, options, threads=threads, background=background_map)
        if config.materials.learn:
            gaussians = add_initial_materials(gaussians, config.materials)
    state = initial_state(gaussians, config.seed)
    shading = make_shading(ShadingOptions.from_config(config), len(dataset.views), dataset.extent)
    background = find_background(shading)
    if background_map is not None and background is not None:
        background.set_map(background_map.resize(config.background_height))
        state.shading = shading.state()
    return state


def gaussians_from_points(
    xyz_world: Float32[np.ndarray, "n 3"],
    rgb_srgb: Float32[np.ndarray, "n 3"],
    camera_centres_world: Float64[np.ndarray, "c 3"],
    *,
    extent: float,
    limit: int,
    opacity: float,
    rng: np.random.Generator,
    plane_points: int = 8,
    most_angles: Float64[np.ndarray, " n"] | None = None,
    region: Region | None = None,
    seen_from: Float64[np.ndarray, "n 3"] | None = None,
) -> FlatGaussians:
    """Return flat Gaussians on sparse points.

    The scales are the mean distance to the three nearest points; the normal is that of the plane through
    the ``plane_points`` nearest where they lie on one, else it looks at the cameras. More than ``limit``
    points are thinned at random. ``most_angles`` are the largest scales as seen from the nearest camera,
    radians; None for ``MAX_ANGULAR_SIZE``. Points of a region are kept before others. Where mean directions
    to the views that observe the points are given in ``seen_from``, normals face these.
    """
    centre = np.median(camera_centres_world, axis=0)
    far = np.linalg.norm(xyz_world - centre, axis=1) > MAX_DISTANCE * extent
    keep = np.flatnonzero(~far & np.isfinite(xyz_world).all(axis=1))
    if len(keep) > limit:  # points that are matching errors should not take the place of others
        likelihood = None
        if region is not None:
            preference = region.preference(xyz_world[keep]).astype(np.float64)
            likelihood = preference / preference.sum()
        keep = np.sort(rng.choice(keep, limit, replace=False, p=likelihood))
    points = xyz_world[keep].astype(np.float64)
    count = len(points)
    if count == 0:
        raise DatasetError(
            "No point of the sparse model lies near the cameras; check the model, or delete its points."
        )
    tree = cKDTree(points)
    neighbor_count = min(count, plane_points + 1)
    distances, neighbours = tree.query(points, neighbor_count)
    distances, neighbours = (
        distances.reshape(count, neighbor_count),
        neighbours.reshape(count, neighbor_count),
    )
    nearest = distances[:, 1 : NEIGHBOURS + 1] if neighbor_count > 1 else np.full((count, 1), 0.01 * extent)
    spacing = nearest.mean(axis=1)
    # neither vanishing nor wider than a fifth of the distance scale
    spacing = np.clip(
        spacing, 1e-5 * extent, 0.2 * extent * np.maximum(1.0, _distances_from(points, centre) / extent)
    )
    # One point alone in front of a camera would hide everything.
    to_camera = cKDTree(camera_centres_world).query(points)[0]
    max_angles = MAX_ANGULAR_SIZE if most_angles is None else most_angles[keep]
    spacing = np.minimum(spacing, np.maximum(max_angles * to_camera, 1e-5 * extent))
    normals = _normalize_or_z_axis(centre - points)  # facing the cameras, where no plane is found
    if neighbor_count == plane_points + 1:
        if seen_from is None:
            normals = plane_normals(points[neighbours], normals)
        else:
            normals = seen_normals(points[neighbours], seen_from[keep], normals)
    return _assemble(points, normals, spacing, rgb_srgb[keep], opacity)


def gaussians_from_rays(
    origins_world: Float32[np.ndarray, "n 3"],
    directions_world: Float32[np.ndarray, "n 3"],
    rgb_srgb: Float32[np.ndarray, "n 3"],
    *,
    extent: float,
    opacity: float,
    rng: np.random.Generator,
) -> FlatGaussians:
    """Return random flat Gaussians in the frustums: one a ray, log-uniform in depth, facing the camera."""
    if len(origins_world) == 0:
        raise DatasetError("The masks or the alpha leave no pixel to begin from; check masks/ and --masks.")
    depths = extent * np.exp(rng.uniform(np.log(0.3), np.log(5.0), len(origins_world)))
    points = origins_world.astype(np.float64) + depths[:, None] * directions_world
    distances = cKDTree(points).query(points, min(len(points), NEIGHBOURS + 1))[0].reshape(len(points), -1)
    spacing = np.clip(
        distances[:, 1:].mean(axis=1) if len(points) > 1 else 0.05 * extent, 1e-4 * extent, extent
    )
    return _assemble(
        points, -directions_world.astype(np.float64), np.broadcast_to(spacing, len(points)), rgb_srgb, opacity
    )


def _assemble(
    points: np.ndarray, normals: np.ndarray, spacing: np.ndarray, rgb_srgb: np.ndarray, opacity: float
) -> FlatGaussians:
    count = len(points)
    return FlatGaussians(
        means_world=points.astype(np.float32),
        quats_wxyz=quaternions_from_matrices(frames_from_normals(normals)).astype(np.float32),
        log_scales=np.repeat(np.log(spacing)[:, None], 2, axis=1).astype(np.float32),
        opacity_logits=np.full(count, np.log(opacity / (1 - opacity)), np.float32),
        sh=((rgb_srgb - 0.5) / SH_C0).astype(np.float32)[:, None, :],
    )


def _normalize_or_z_axis(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 0, vectors / np.where(length > 0, length, 1.0), np.array([0.0, 0.0, 1.0]))


def _distances_from(points: np.ndarray, centre: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(points - centre, axis=1))
