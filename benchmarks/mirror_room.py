"""A room of textured walls with a mirror ball in it: what reflects stands among what it reflects.

    python -m benchmarks.mirror_room -o ROOM                         # 30 views of 120 px, some CPU seconds
    octasplat reconstruct ROOM -o OUT --materials --test-every 5
    octasplat render OUT -o VIEWS
    python -m benchmarks.mirror_room --compare VIEWS -o ROOM         # PSNR of the ball, and of all else

All by formulas: walls send the colors of their patterns the same in all directions, the ball mirrors them.
``ground_truth/masks`` holds where the ball is.
"""

import argparse
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Bool, Float, Float64

from octasplat.engine.core.color import linear_to_srgb, srgb_to_linear, to_bytes
from octasplat.engine.dataset.synthetic.colmap_writer import write_model
from octasplat.engine.dataset.synthetic.photograph_renderer import rays_world
from octasplat.engine.dataset.synthetic.points import SurfacePoints, list_observations
from octasplat.engine.dataset.synthetic.synthetic_views import SyntheticView, directions_cam, project_visible
from octasplat.engine.render.image_files import read_image, write_png

LOW, HIGH = np.array([-2.0, -2.0, 0.0]), np.array([2.0, 2.0, 2.6])
"""Corners of the room, metres; z is up."""
CENTRE, RADIUS = np.array([0.2, -0.1, 1.1]), 0.5
"""Of the ball."""
TINT = np.array([0.95, 0.93, 0.88])
"""Share of the light that the ball mirrors, linear."""
HALF_FOV = np.radians(32)
SAMPLES = 4
"""A pixel is the mean of this number squared, in linear light."""
BALL_POINTS = 0.08
"""Share of the sparse points that lies on the ball, as of dust and scratches."""


def wall_colors(points_world: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Return the linear radiance of points of the room's walls, floor and ceiling."""
    gaps = np.concatenate([np.abs(points_world - LOW), np.abs(points_world - HIGH)], axis=1)
    wall = gaps.argmin(axis=1)
    axis = wall % 3
    u = np.where(axis == 0, points_world[:, 1], points_world[:, 0])
    v = np.where(axis == 2, points_world[:, 1], points_world[:, 2])
    base = np.array(
        [[0.75, 0.3, 0.25], [0.25, 0.55, 0.3], [0.5, 0.42, 0.32], [0.25, 0.35, 0.7], [0.75, 0.65, 0.3],
         [0.85, 0.85, 0.82]]
    )[wall]  # fmt: skip
    checks = np.where((np.floor(u / 0.5) + np.floor(v / 0.5)) % 2 == 0, 1.0, 0.55)
    waves = 0.85 + 0.15 * np.sin(3.1 * u + wall) * np.sin(4.3 * v - wall)
    # a bright picture on each wall
    picture = (np.abs(u - 0.3) < 0.45) & (np.abs(v - 1.4) < 0.4) & (axis < 2)
    shown = np.where(picture[:, None], 1.0 - 0.7 * base, base * (checks * waves)[:, None])
    return srgb_to_linear(np.clip(shown, 0.0, 1.0))


def hit_ball(
    origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
) -> Float64[np.ndarray, " n"]:
    """Return distances to the ball along unit directions; infinite where it is missed."""
    away = origins - CENTRE
    half = (away * directions).sum(axis=1)
    root = half**2 - (away**2).sum(axis=1) + RADIUS**2
    return np.where((root > 0) & (half < 0), -half - np.sqrt(np.maximum(root, 0)), np.inf)


def hit_walls(
    origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 3"]:
    """Return the points of the room's inside that rays from within it meet."""
    with np.errstate(divide="ignore"):
        ends = np.abs(np.where(directions > 0, HIGH - origins, LOW - origins) / directions)
    return origins + ends.min(axis=1, keepdims=True) * directions


def radiance(
    origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 3"]:
    """Return what rays from within the room see, linear; directions need no unit length."""
    o = origins.astype(np.float64)
    d = directions / np.linalg.norm(directions, axis=1, keepdims=True).astype(np.float64)
    t = hit_ball(o, d)
    colors, ball = wall_colors(hit_walls(o, d)), np.isfinite(t)
    points = o[ball] + t[ball, None] * d[ball]
    normals = (points - CENTRE) / RADIUS
    mirrored = d[ball] - 2 * (d[ball] * normals).sum(axis=1, keepdims=True) * normals
    colors[ball] = TINT * wall_colors(hit_walls(points, mirrored))
    return colors


def room_views(count: int, seed: int = 0) -> list[SyntheticView]:
    """Return views all around the ball, from within the room."""
    random = np.random.default_rng(seed)
    made = []
    for k in range(count):
        angle = 2 * np.pi * (k * 0.618034 + random.uniform(-0.02, 0.02))
        reach = random.uniform(1.35, 1.7)
        centre = np.array([reach * np.cos(angle), reach * np.sin(angle), random.uniform(0.5, 2.1)])
        ahead = CENTRE + random.uniform(-0.3, 0.3, 3) - centre
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(ahead, right), ahead])
        made.append(SyntheticView(f"view_{k:03d}.png", rotation, -rotation @ centre))
    return made


def sparse_points(camera: pycolmap.Camera, views: list[SyntheticView], count: int) -> SurfacePoints:
    """Return points of the walls and some of the ball, with the views that see them."""
    random = np.random.default_rng(1)
    outwards = random.standard_normal((count, 3))
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    points = hit_walls(np.broadcast_to((LOW + HIGH) / 2, outwards.shape), outwards)
    on_ball = round(BALL_POINTS * count)
    points[:on_ball] = CENTRE + RADIUS * outwards[:on_ball]
    seen = np.full((count, len(views), 2), np.nan)
    colors = np.full((count, 3), 128, np.uint8)
    for k, view in enumerate(views):
        away = points - view.centre_world
        distances = np.linalg.norm(away, axis=1)
        starts = np.broadcast_to(view.centre_world, away.shape)
        directions = away / distances[:, None]
        free = hit_ball(starts, directions) > distances - 1e-6
        seen[free, k] = project_visible(camera, view, points[free])
        visible = np.isfinite(seen[:, k, 0])
        colors[visible] = to_bytes(linear_to_srgb(radiance(starts[visible], directions[visible])))
    good = np.isfinite(seen[..., 0]).sum(axis=1) >= 2
    noisy = points[good] + random.normal(0, 0.002, (int(good.sum()), 3))
    return SurfacePoints(noisy, colors[good], *list_observations(seen[good]))


def ball_mask(camera: pycolmap.Camera, view: SyntheticView) -> Bool[np.ndarray, "h w"]:
    """Return which pixels have the ball at their centre."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    origins, directions = rays_world(view, directions_cam(camera, np.stack([x, y], axis=-1).reshape(-1, 2)))
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return np.isfinite(hit_ball(origins, unit)).reshape(camera.height, camera.width)


def photograph(camera: pycolmap.Camera, view: SyntheticView) -> Float64[np.ndarray, "h w 3"]:
    """Return a photograph, display values."""
    steps = (np.arange(camera.width * SAMPLES) + 0.5) / SAMPLES
    x, y = np.meshgrid(steps, (np.arange(camera.height * SAMPLES) + 0.5) / SAMPLES)
    origins, directions = rays_world(view, directions_cam(camera, np.stack([x, y], axis=-1).reshape(-1, 2)))
    fine = radiance(origins, directions).reshape(camera.height, SAMPLES, camera.width, SAMPLES, 3)
    return linear_to_srgb(fine.mean(axis=(1, 3)))


def write_room(folder: Path, *, views: int = 30, side: int = 120, points: int = 3000) -> None:
    """Write photographs, a model of their cameras, and masks of the ball."""
    focal = 0.5 * side / np.tan(HALF_FOV)
    camera = pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=side, height=side, params=[focal, focal, side / 2, side / 2]
    )
    for name in ("images", "ground_truth/masks"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    made = room_views(views)
    for view in made:
        write_png(folder / "images" / view.name, photograph(camera, view).astype(np.float32))
        mask = ball_mask(camera, view).astype(np.float32)
        write_png(folder / "ground_truth/masks" / view.name, np.repeat(mask[..., None], 3, axis=2))
    write_model(folder / "sparse" / "0", camera, made, sparse_points(camera, made, points))


def compare(pictures: Path, room: Path) -> dict[str, float]:
    """Return the PSNR of pictures, display values: of the ball, of all else, and of everything."""
    squares: dict[str, list[np.ndarray]] = {"ball": [], "room": [], "all": []}
    for path in sorted(pictures.glob("view_*.png")):
        error = (read_image(path)[..., :3] - read_image(room / "images" / path.name)[..., :3]) ** 2
        ball = read_image(room / "ground_truth/masks" / path.name)[..., 0] > 0.5
        for name, part in (("ball", error[ball]), ("room", error[~ball]), ("all", error.reshape(-1, 3))):
            squares[name].append(part)
    means = {name: float(np.concatenate(parts).mean()) for name, parts in squares.items()}
    return {name: -10 * float(np.log10(mean)) if mean > 0 else np.inf for name, mean in means.items()}


def main() -> None:
    """Write the room, or compare pictures with its photographs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the room")
    parser.add_argument("--compare", type=Path, nargs="+", help="folders of rendered views")
    parser.add_argument("--views", type=int, default=30)
    parser.add_argument("--side", type=int, default=120, help="pixels of a picture's side")
    given = parser.parse_args()
    if given.compare is None:
        write_room(given.output, views=given.views, side=given.side)
        return
    for pictures in given.compare:
        found = compare(pictures, given.output)
        print(f"{pictures}: " + ", ".join(f"{name} {value:.2f} dB" for name, value in found.items()))


if __name__ == "__main__":
    main()
