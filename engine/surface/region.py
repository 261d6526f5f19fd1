"""The region of space that is fused, and its voxel grid."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float64

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.engine.render.pose_paths import fit_turntable
from octasplat.engine.surface.depth_maps import DepthMaps
from octasplat.engine.surface.options import ExtractionOptions

BLOCK = 8
"""Voxels along a side of a block."""
MAX_BLOCKS_PER_SIDE = 512
CONTRACTED_HALF_SIDE = 2.0
"""Contracted space fills the ball of this radius."""
MIN_TRUNCATION_VOXELS = 4.0
TRUNCATION_SHARE = 0.03
"""Of the cameras' distance; what gave the best F-score on the generated scene, whatever the voxels."""
RESOLUTION = 512
PIXELS_PER_VOXEL = 1.5
SAMPLES_PER_SIDE = 160
OUTLIER_SHARE = 1e-3
MARGIN_SHARE = 0.05
NO_SURFACE_MESSAGE = (
    "No surface lies in the region to mesh; name another with --box (octasplat info tells where the scene "
    "lies), or use --unbounded."
)
_ANY_AXIS = np.array([0.36, 0.48, 0.8])


@dataclass(frozen=True)
class Region:
    """A grid of cubic voxels over a box, or over all of space by contraction.

    Contraction is Eq. 10 of "Mip-NeRF 360: Unbounded Anti-Aliased Neural Radiance Fields"
    (https://arxiv.org/abs/2111.12077): with x = (world - centre) / radius, x stays where it is inside the
    unit ball and goes to (2 - 1/|x|) x/|x| outside. The grid then lies over the box [-2, 2]^3 and its unit
    is ``radius``.

    Attributes:
        low: least corner of the grid, world units or contracted.
        voxel: side of a voxel in the same units.
        blocks: number of blocks of 8^3 voxels along x, y and z.
        contracted: whether grid coordinates are contracted.
        centre_world: centre of the contraction; zero if there is none.
        radius: of the unit ball, world units; 1 if there is none.
        truncation: half width of the band around the surface, in voxels.
    """

    low: Float64[np.ndarray, "3"]
    voxel: float
    blocks: tuple[int, int, int]
    contracted: bool
    centre_world: Float64[np.ndarray, "3"]
    radius: float
    truncation: float

    @property
    def voxel_world(self) -> float:
        """Return the side of a voxel in world units; at the centre if contracted."""
        return self.voxel * self.radius

    def world_from_grid(self, points: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Return world positions of points in voxel coordinates, whose origin is the first voxel's centre."""
        at = self.low + (points.astype(np.float64) + 0.5) * self.voxel
        if not self.contracted:
            return at
        length = np.linalg.norm(at, axis=1, keepdims=True)
        # Beyond the ball of radius 2 lies nothing; its rim stands for infinity.
        stretch = 1.0 / np.maximum(2.0 - length, 1e-4) / np.maximum(length, 1.0)
        return self.centre_world + self.radius * np.where(length > 1.0, stretch, 1.0) * at


def choose_region(maps: DepthMaps, options: ExtractionOptions) -> Region:
    """Return the region that the options ask for, or the visible space that the cameras surround.

    That space is a cube around the point nearest to all viewing axes, as far to each side as the cameras are
    away from it in the median; of it, the box that holds the depths seen.

    Raises:
        ConfigError: the cameras have no common centre and the options name no box, nothing is seen, or the
            grid is too fine.
    """
    pixel = 0.0 if options.resolution is not None else _pixel_width(maps.cameras)
    if options.box is not None:
        low, high = np.array(options.box[:3]), np.array(options.box[3:])
        try:
            _, distance = focus_point(maps.cameras)
        except ConfigError:
            distance = 0.5 * float((high - low).max())
        # the size stands in for a distance that is not known
        return _make_grid(low, high, distance, pixel * distance, options)
    centre, distance = focus_point(maps.cameras)
    if not options.unbounded:
        box = _depth_bounds(maps, centre - distance, centre + distance)
        return _make_grid(*box, distance, pixel * distance, options)
    half = np.full(3, CONTRACTED_HALF_SIDE)
    # voxels are given in world units, the grid is in those of the radius
    voxel = None if options.voxel is None else options.voxel / distance
    grid = _make_grid(-half, half, 1.0, pixel, options.model_copy(update={"voxel": voxel}))
    return replace(grid, contracted=True, centre_world=centre, radius=distance)


def _pixel_width(cameras: Sequence[PinholeCamera]) -> float:
    """Return the median width of a pixel at distance 1."""
    return float(np.median([1.0 / camera.fx_px for camera in cameras]))


def _depth_bounds(
    maps: DepthMaps, low: Float64[np.ndarray, "3"], high: Float64[np.ndarray, "3"]
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
    """Return the box of the depths within a cube, without outliers, and with a margin."""
    found = []
    for camera, distances in zip(maps.cameras, maps.distances, strict=True):
        step = max(1, max(distances.shape) // SAMPLES_PER_SIDE)
        rays = camera.rays()
        some = np.asarray(distances[::step, ::step])
        known = (some > 0) & np.isfinite(some)
        points = rays.origin_world + some[known][:, None] * rays.directions_world[::step, ::step][known]
        found.append(points[((points > low) & (points < high)).all(axis=1)])
    points = np.concatenate(found)
    if len(points) == 0:
        raise ConfigError(NO_SURFACE_MESSAGE)
    least, most = np.quantile(points, [OUTLIER_SHARE, 1 - OUTLIER_SHARE], axis=0).astype(np.float64)
    margin = MARGIN_SHARE * float((most - least).max())
    return np.maximum(low, least - margin), np.minimum(high, most + margin)  # not beyond the cube


def focus_point(cameras: Sequence[PinholeCamera]) -> tuple[Float64[np.ndarray, "3"], float]:
    """Return the point that the cameras look at, and their median distance to it.

    Raises:
        ConfigError: there is no such point.
    """
    centres = np.stack([camera.centre_world for camera in cameras])
    rotations = np.stack([camera.rotation_cam_from_world for camera in cameras])
    try:
        # Any axis will do: only the centre is used, and cameras all around share no up direction.
        point = fit_turntable(centres, rotations[:, 2], np.tile(_ANY_AXIS, (len(centres), 1))).centre_world
    except ConfigError:
        raise ConfigError(
            "The cameras look at no common centre; name the region to mesh with --box x0 y0 z0 x1 y1 z1."
        ) from None
    return point, float(np.median(np.linalg.norm(centres - point, axis=1)))


def _make_grid(
    low: Float64[np.ndarray, "3"],
    high: Float64[np.ndarray, "3"],
    distance: float,
    pixel: float,
    options: ExtractionOptions,
) -> Region:
    """Return the grid over a box seen from ``distance``, where a pixel is ``pixel`` wide."""
    side = float((high - low).max())
    voxel = options.voxel or max(side / (options.resolution or RESOLUTION), PIXELS_PER_VOXEL * pixel)
    # rounding must not add a row of blocks
    blocks = np.maximum(1, np.ceil((high - low) / (voxel * BLOCK) - 1e-6)).astype(int)
    if blocks.max() > MAX_BLOCKS_PER_SIDE:
        raise ConfigError(
            f"The region has {int(blocks.max()) * BLOCK:,} voxels along a side, but at most "
            f"{MAX_BLOCKS_PER_SIDE * BLOCK:,} are possible; choose larger voxels or a smaller region."
        )
    size = (int(blocks[0]), int(blocks[1]), int(blocks[2]))
    truncation = options.truncation or max(MIN_TRUNCATION_VOXELS, TRUNCATION_SHARE * distance / voxel)
    return Region(
        low=low.astype(np.float64),
        voxel=float(voxel),
        blocks=size,
        contracted=False,
        centre_world=np.zeros(3),
        radius=1.0,
        truncation=truncation,
    )
