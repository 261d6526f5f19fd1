"""Photographs along a painted wall, each of a part of it: what one end needs the other does not."""

from pathlib import Path

import numpy as np
from PIL import Image

WIDTH_PX, HEIGHT_PX, FOCAL_PX = 48, 40, 40.0
STEP, DISTANCE = 0.35, 1.0
"""Between two cameras, and from them to the wall, world units."""


def make_wall_dataset(
    root: Path, *, views: int = 16, points: int = 600, with_masks: bool = False, with_depths: bool = False
) -> Path:
    """Write photographs, masks and depth maps of the wall z = 0 and its COLMAP model, as text.

    Camera i is at x = i STEP and looks along +z from z = -DISTANCE. Every second photograph has a mask.
    The exposure changes from each photograph to the next.
    """
    generator = np.random.default_rng(0)
    folders = ["images", "sparse/0", *["masks"] * with_masks, *["depths"] * with_depths]
    for folder in folders:
        (root / folder).mkdir(parents=True, exist_ok=True)
    y_px, x_px = np.mgrid[:HEIGHT_PX, :WIDTH_PX] + 0.5
    x_world = np.array([generator.uniform(-0.6, STEP * (views - 1) + 0.6, points),
                        generator.uniform(-0.5, 0.5, points)])  # fmt: skip
    names, rows, tracks = [f"{number:03d}.png" for number in range(views)], [], [[] for _ in range(points)]
    for number, name in enumerate(names):
        offset = STEP * number
        wall = (
            (x_px - WIDTH_PX / 2) * DISTANCE / FOCAL_PX + offset,
            (y_px - HEIGHT_PX / 2) * DISTANCE / FOCAL_PX,
        )
        colors = np.rint((255, 190)[number % 2] * _paint(*wall)).astype(np.uint8)
        Image.fromarray(colors).save(root / "images" / name)
        if with_masks and number % 2:
            mask = np.where(y_px > 8, 255, 0).astype(np.uint8)
            Image.fromarray(mask).save(root / "masks" / f"{name}.png")
        if with_depths:
            depth = np.full((HEIGHT_PX, WIDTH_PX), round(1000 * DISTANCE), np.uint16)
            Image.fromarray(depth).save(root / "depths" / name)
        seen = np.stack([(x_world[0] - offset) * FOCAL_PX / DISTANCE + WIDTH_PX / 2,
                         x_world[1] * FOCAL_PX / DISTANCE + HEIGHT_PX / 2], axis=1)  # fmt: skip
        inside = np.flatnonzero(((seen > 0) & (seen < (WIDTH_PX, HEIGHT_PX))).all(axis=1))
        for place, point in enumerate(inside):
            tracks[point] += [number + 1, place]
        observed = " ".join(f"{seen[p, 0]:.4f} {seen[p, 1]:.4f} {p + 1}" for p in inside)
        rows += [f"{number + 1} 1 0 0 0 {-offset:.6f} 0 {DISTANCE} 1 {name}", observed]
    model = root / "sparse/0"
    camera = f"1 PINHOLE {WIDTH_PX} {HEIGHT_PX} {FOCAL_PX} {FOCAL_PX} {WIDTH_PX / 2} {HEIGHT_PX / 2}\n"
    (model / "cameras.txt").write_text(camera)
    (model / "images.txt").write_text("\n".join(rows) + "\n")
    paint = np.rint(255 * _paint(*x_world)).astype(int)
    (model / "points3D.txt").write_text("".join(
        f"{p + 1} {x_world[0, p]:.6f} {x_world[1, p]:.6f} 0 {' '.join(map(str, paint[p]))} 0.1 "
        f"{' '.join(map(str, tracks[p]))}\n" for p in range(points) if tracks[p]
    ))  # fmt: skip
    return root


def _paint(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    waves = [np.sin(5.0 * x + 2.0 * y), np.sin(3.0 * x - 4.0 * y), np.cos(7.0 * x + 1.0) * np.cos(6.0 * y)]
    return 0.5 + 0.35 * np.stack(waves, axis=-1)
