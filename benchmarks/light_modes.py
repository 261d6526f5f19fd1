"""Pictures for ``docs/light.md`` and ``docs/materials.md``: ways of lighting Gaussians, on generated scenes.

    python -m benchmarks.light_modes                 # writes docs/images/light/ and docs/images/materials/
    python -m benchmarks.light_modes --only relit

Each picture is one command of the program, which is printed.
"""

import argparse
import shlex
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians, concatenate
from octasplat.engine.render.environment_files import write_environment
from tests.support.light_scenes import shiny_ball, table_with_a_box

DOCS = Path(__file__).resolve().parents[1] / "docs" / "images"
CAMERA = [
    "--camera",
    "0.55",
    "-1.0",
    "-1.75",
    "--look-at",
    "0",
    "-0.1",
    "0.05",
    "--width",
    "240",
    "--height",
    "180",
    "--fov",
    "40",
]
BALL = """
[[meshes]]
shape = "sphere"
position = [-0.48, -0.22, -0.05]
scale = 0.22
smooth_degrees = 180
material = { kind = "diffuse", color_srgb = [0.8, 0.8, 0.8] }
"""
LAMP = """
[[lights]]
kind = "directional"
direction = [0.75, 1.0, 0.35]
irradiance = 2.0
"""
MODES = {
    "emissive": 'light = "emissive"',
    "shadowed": 'light = "shadowed"',
    "shadowed_ambient": 'light = "shadowed"\nambient = 0.8',
    "new_light": 'light = "shadowed"',
    "new_light_shadows": 'light = "shadowed"\nshadows_on_gaussians = true',
    "relit": 'light = "relit"\nshadows_on_gaussians = true\nambient = 0.1',
}
"""Name of the picture, and what its stage says of the Gaussians."""


def stage(name: str) -> str:
    """Return the text of a mode's stage: the scene, a ball and a lamp, which is new in some."""
    lamp = LAMP.replace("2.0", "1.2") + "adds_light = true\n" if name.startswith("new_light") else LAMP
    return f"[[gaussians]]\n{MODES[name]}\n{BALL}{lamp}[integrator]\nsamples = 64\n"


def gold_on_table() -> FlatGaussians:
    """Return a ball of gold on a matt grey table, with materials and the colors of even white light."""
    table = table_with_a_box()
    table = table.select(table.means_world[:, 1] > -0.001)
    matt = {
        "albedo": np.full((len(table), 3), 0.35, np.float32),
        "metallic": np.zeros((len(table), 1), np.float32),
        "roughness": np.full((len(table), 1), 0.8, np.float32),
    }
    ball = shiny_ball(6000, 0.3, albedo=(1.0, 0.77, 0.34), metallic=1.0, roughness=0.15)
    ball.means_world[:, 1] -= 0.3
    ball.sh[:, 0] = (np.float32([0.72, 0.6, 0.36]) - 0.5) / np.float32(SH_C0)
    return concatenate([table.with_channels(matt), ball])


def studio() -> np.ndarray:
    """Return the linear radiance of a dim room with two windows, 64 x 128 texels."""
    rows, columns = np.mgrid[0:64, 0:128]
    room = np.where(rows[..., None] < 32, np.float32([0.25, 0.28, 0.33]), np.float32([0.12, 0.1, 0.09]))
    for first, last, color in ((20, 40, (9.0, 8.0, 6.5)), (84, 92, (3.0, 4.5, 7.0))):
        window = (rows > 10) & (rows < 26) & (columns >= first) & (columns < last)
        room = np.where(window[..., None], np.float32(color), room)
    return room.astype(np.float32)


def commands(folder: Path) -> dict[Path, list[str]]:
    """Write scenes, stages and maps to a folder; return a command for each picture, less its output."""
    write_gaussian_ply(table_with_a_box(), folder / "table.ply")
    write_gaussian_ply(gold_on_table(), folder / "gold.ply")
    write_environment(folder / "studio.hdr", studio())
    found = {}
    for name in MODES:
        (folder / f"{name}.toml").write_text(stage(name), encoding="utf-8")
        found[DOCS / "light" / f"mode_{name}.png"] = ["render", "table.ply", "--stage", f"{name}.toml"]
    relight = ["relight", "gold.ply", "--environment", "studio.hdr", "--up", "-y"]
    found[DOCS / "materials" / "harmonics.png"] = ["render", "gold.ply"]
    found[DOCS / "materials" / "split_sum.png"] = relight
    found[DOCS / "materials" / "background.png"] = [*relight, "--background", "environment"]
    return found


def main() -> None:
    """Render the pictures that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--only", help="name of one picture, without its suffix")
    only = parser.parse_args().only
    with TemporaryDirectory() as folder:
        for picture, command in commands(Path(folder)).items():
            if only not in (None, picture.stem, picture.stem.removeprefix("mode_")):
                continue
            whole = [*command, *CAMERA, "-o", str(picture), "--overwrite"]
            print("octasplat", shlex.join([*command, *CAMERA, "-o", picture.name]), flush=True)
            picture.parent.mkdir(parents=True, exist_ok=True)
            subprocess.run([sys.executable, "-m", "octasplat", *whole], cwd=folder, check=True)


if __name__ == "__main__":
    main()
