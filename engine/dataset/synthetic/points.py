"""Surface points that several photographs observe, as structure from motion would find them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.core.color import to_bytes
from octasplat.engine.dataset.synthetic.config import SyntheticDatasetConfig
from octasplat.engine.dataset.synthetic.lit_scene import LitScene
from octasplat.engine.dataset.synthetic.photograph_renderer import rays_world
from octasplat.engine.dataset.synthetic.synthetic_views import SyntheticView, directions_cam, project_visible

# Standard deviation of the points' error, as a share of the extent of the cameras.
_POSITION_NOISE = 1e-4
# A point is seen if its ray ends this close to it, as a share of the distance.
_VISIBILITY_TOLERANCE = 1 - 5e-4
# A feature is recognised in views from up to so many times as far as the nearest one that shows it.
_MAX_DISTANCE_RATIO = 4.0
_BATCH = 4096
_MAX_BATCHES = 400


@dataclass(frozen=True)
class SurfacePoints:
    """Points and their tracks.

    Attributes:
        xyz_world: Positions with a little noise.
        rgb_srgb8: Mean display colors of a pixel that shows them.
        observed_points: Row of the point of each observation, ascending.
        observing_views: Index of the view of each observation; ascending for each point.
        observed_px: Exact image positions of the noiseless points.
    """

    xyz_world: Float[np.ndarray, "n 3"]
    rgb_srgb8: UInt8[np.ndarray, "n 3"]
    observed_points: Int[np.ndarray, " m"]
    observing_views: Int[np.ndarray, " m"]
    observed_px: Float[np.ndarray, "m 2"]


def list_observations(
    observed_px: Float[np.ndarray, "n views 2"],
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"], Float[np.ndarray, "m 2"]]:
    """Return row of the point, view and image position of each observation; not-a-number is none."""
    rows, views = np.nonzero(np.isfinite(observed_px[..., 0]))
    return rows, views, observed_px[rows, views]


def sample_surface_points(
    scene: LitScene, camera: pycolmap.Camera, views: list[SyntheticView], config: SyntheticDatasetConfig
) -> SurfacePoints:
    """Sample ``config.points`` surface points under random pixels, each observed by at least two views.

    Where only the objects are to be reconstructed, the points lie on these. Fewer points come back if the
    views hardly overlap.
    """
    random = np.random.default_rng([config.seed, 2])
    places: list[np.ndarray] = []
    colors: list[np.ndarray] = []
    tracks: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    centres = np.array([view.centre_world for view in views])
    found = 0
    for _ in range(_MAX_BATCHES):
        chosen = np.sort(random.integers(len(views), size=_BATCH))
        pixels = random.uniform(0.5, np.array([camera.width, camera.height]) - 0.5, (_BATCH, 2))
        xyz, rgb = _points_under_pixels(
            scene, camera, [views[k] for k in chosen], pixels, config.objects_only
        )
        observed = np.stack([_project_unoccluded(scene, camera, view, xyz) for view in views], axis=1)
        observed[_is_too_far(xyz, centres, np.isfinite(observed[..., 0]))] = np.nan
        good = np.sum(np.isfinite(observed[..., 0]), axis=1) >= 2
        # The batch is sorted by view; a shuffle keeps a cut at the wanted number fair to all views.
        order = random.permutation(np.flatnonzero(good))[: config.points - found]
        places.append(xyz[order])
        colors.append(rgb[order])
        rows, seeing, observed_px = list_observations(observed[order])
        tracks.append((found + rows, seeing, observed_px))
        found += len(order)
        if found == config.points:
            break
    xyz = np.concatenate(places)
    extent = float(np.linalg.norm(np.ptp(centres, axis=0)))
    return SurfacePoints(
        xyz + random.normal(0, _POSITION_NOISE * extent, xyz.shape),
        np.concatenate(colors),
        *(np.concatenate(parts) for parts in zip(*tracks, strict=True)),
    )


def _is_too_far(
    xyz: Float[np.ndarray, "n 3"], centres: Float[np.ndarray, "views 3"], is_seen: Bool[np.ndarray, "n views"]
) -> Bool[np.ndarray, "n views"]:
    """Return from which centres a point is too small to be known for that of the nearest one that sees it."""
    distances = np.stack([np.linalg.norm(xyz - centre, axis=1) for centre in centres], axis=1)
    nearest = np.min(distances, axis=1, where=is_seen, initial=np.inf, keepdims=True)
    return np.asarray(distances > _MAX_DISTANCE_RATIO * nearest)


def _points_under_pixels(
    scene: LitScene,
    camera: pycolmap.Camera,
    views: list[SyntheticView],
    pixels: Float[np.ndarray, "n 2"],
    objects_only: bool,
) -> tuple[Float[np.ndarray, "m 3"], UInt8[np.ndarray, "m 3"]]:
    """Return the surface points seen at image positions, and the mean color of 3 x 3 samples around each."""
    steps = (np.arange(3) + 0.5) / 3 - 0.5
    around = pixels[:, None] + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(1, 9, 2)
    directions = directions_cam(camera, around.reshape(-1, 2)).reshape(-1, 9, 3)
    rays = [rays_world(view, rows) for view, rows in zip(views, directions, strict=True)]
    origins, along = (np.concatenate(parts) for parts in zip(*rays, strict=True))
    hits = scene.trace(origins, along)
    colors = scene.shade_hits(hits, origins, along).reshape(-1, 9, 3).mean(axis=1)
    middle = slice(4, None, 9)  # the pixel itself among its 3 x 3 samples
    face = hits.faces[middle]
    selected: Bool[np.ndarray, " n"] = face >= 0
    if objects_only:
        selected &= scene.unlit.face_is_foreground[face]
    distance = np.where(selected, hits.distances[middle], 0).astype(np.float64)
    xyz = origins[middle] + distance[:, None] * along[middle]
    return xyz[selected], to_bytes(colors[selected])


def _project_unoccluded(
    scene: LitScene, camera: pycolmap.Camera, view: SyntheticView, xyz: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 2"]:
    """Return the image positions of the points that ``view`` observes, not-a-number for the others."""
    pixels = project_visible(camera, view, xyz)
    inside = np.flatnonzero(np.isfinite(pixels[:, 0]))
    ways = (xyz[inside] - view.centre_world).astype(np.float32)
    origins = np.broadcast_to(view.centre_world.astype(np.float32), ways.shape).copy()
    # Distances count in lengths of the way: the point itself lies at 1.
    hidden = scene.trace(origins, ways).distances < _VISIBILITY_TOLERANCE
    pixels[inside[hidden]] = np.nan
    return pixels
