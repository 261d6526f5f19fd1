"""Writes a glazed vase: ``vase.obj`` with ``vase.mtl`` and ``vase.png``, to be put into a stage.

python examples/light/vase.py
"""

from pathlib import Path

import numpy as np

from octasplat.engine.render.image_files import write_png

ROUND, HIGH, PIXELS = 96, 64, 512
THICK = 0.06
PROFILE = [(0.0, 0.42), (0.1, 0.5), (0.55, 0.82), (0.95, 0.78), (1.35, 0.42), (1.6, 0.34), (1.8, 0.5)]
"""Height and radius of the outside."""


def outline() -> np.ndarray:
    """Radius and height from the middle of the foot up the outside, and down the inside again."""
    heights, radii = np.array(PROFILE).T
    y = np.linspace(0, heights[-1], HIGH)
    smooth = np.interp(y, heights, radii)
    for _ in range(40):
        smooth[1:-1] = 0.25 * smooth[:-2] + 0.5 * smooth[1:-1] + 0.25 * smooth[2:]
    outside = np.stack([smooth, y], axis=1)
    inside = np.stack([np.maximum(smooth - THICK, 0.02), np.maximum(y, THICK)], axis=1)[::-1]
    return np.concatenate([[[0.0, 0.0]], outside, inside, [[0.0, THICK]]])


def glaze() -> np.ndarray:
    """Blue bands and dots on off-white, as display values."""
    v, u = np.mgrid[0:PIXELS, 0:PIXELS] / PIXELS
    blue = (np.abs(v - 0.22) < 0.012) | (np.abs(v - 0.3) < 0.02) | (np.abs(v - 0.05) < 0.02)
    dots = (u * 12 % 1 - 0.5) ** 2 / 0.5 + ((v - 0.4) / 0.09) ** 2 < 0.25
    waves = np.abs(v - 0.38 - 0.03 * np.sin(2 * np.pi * 6 * u)) < 0.008
    color = np.where((blue | dots | waves)[..., None], [0.09, 0.2, 0.5], [0.9, 0.88, 0.82])
    return np.asarray(color.astype(np.float32))


def main() -> None:
    """Write the three files beside this one."""
    folder = Path(__file__).parent
    write_png(folder / "vase.png", glaze())
    (folder / "vase.mtl").write_text("newmtl glaze\nmap_Kd vase.png\nPr 0.18\nPm 0\nNi 1.5\n")
    line = outline()
    along = np.linspace(0, 1, len(line))
    angles = 2 * np.pi * np.arange(ROUND) / ROUND
    lines = ["mtllib vase.mtl", "usemtl glaze"]
    for radius, y in line:
        lines += [f"v {radius * np.cos(a):.6f} {y:.6f} {-radius * np.sin(a):.6f}" for a in angles]
    # One column more of texture coordinates than of points: the seam.
    for v in along:
        lines += [f"vt {k / ROUND:.6f} {1 - v:.6f}" for k in range(ROUND + 1)]
    for j in range(len(line) - 1):
        for k in range(ROUND):
            points = [j * ROUND + k, j * ROUND + (k + 1) % ROUND, (j + 1) * ROUND + (k + 1) % ROUND]
            points.append((j + 1) * ROUND + k)
            places = [j * (ROUND + 1) + k, j * (ROUND + 1) + k + 1, (j + 1) * (ROUND + 1) + k + 1]
            places.append((j + 1) * (ROUND + 1) + k)
            lines.append("f " + " ".join(f"{p + 1}/{t + 1}" for p, t in zip(points, places, strict=True)))
    (folder / "vase.obj").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
