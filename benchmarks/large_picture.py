"""A picture of a scene of many Gaussians: the tree, the first picture, and the next one.

    python -m benchmarks.large_picture OUT [--gaussians 1000000] [--width 1920] [--height 1080]

The scene of a run is brought to the number of Gaussians by putting several smaller ones in the place of each,
in its plane. Light passes between them, so that a ray meets more than in a scene that was trained so. Prints
seconds by the clock and of CPU for the tree of the tracer, for a picture from where the first photograph was
taken, for the next one of a film (a hundredth of the scene to the side; the tree is kept), and for the first
again.
"""

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before OpenMP is loaded, as the command line does

from octasplat.engine.dataset.views_file import read_views
from octasplat.engine.files import read_scene
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.image_files import write_png
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.engine.render.renderer import RenderedImage, background_color, render_rays
from octasplat.engine.runs.run_folder import VIEWS
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import TraceSettings

Made = TypeVar("Made")
FOCAL_OF_WIDTH = 0.9
"""About 58 degrees from side to side."""


def split(gaussians: FlatGaussians, count: int, seed: int = 0) -> FlatGaussians:
    """Put smaller Gaussians in the place of each, until there are ``count`` of them or one less for each.

    Those of one place lie in its plane, spread as it is, and are as much smaller as they are many.
    """
    parts = count // len(gaussians)
    if parts < 2:
        return gaussians
    rng = np.random.default_rng(seed)
    chosen = np.repeat(np.arange(len(gaussians)), parts)
    children = gaussians.select(chosen)
    scales = np.exp(children.log_scales)
    offsets = np.zeros((len(children), 3))
    offsets[:, :2] = rng.normal(size=(len(children), 2)) * scales * np.sqrt(1 - 1 / parts)
    turned = np.einsum("nij,nj->ni", children.rotations, offsets)
    return replace(
        children,
        means_world=(children.means_world + turned).astype(np.float32),
        log_scales=(children.log_scales - 0.5 * np.log(parts)).astype(np.float32),
    )


def timed(name: str, made: Callable[[], Made]) -> Made:
    """Call a function; print how long it took."""
    began, spent = time.perf_counter(), time.process_time()
    result = made()
    print(f"{name:24} {time.perf_counter() - began:7.2f} s {time.process_time() - spent:7.2f} CPU s")
    return result


def main() -> None:
    """Print the times."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("run", type=Path)
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--width", type=int, default=1920)
    parser.add_argument("--height", type=int, default=1080)
    parser.add_argument("--threads", type=int, default=0, help="0 takes all")
    parser.add_argument("--picture", type=Path, help="file of the first picture, PNG")
    given = parser.parse_args()
    trained = read_scene(given.run)[0]
    record = read_views(given.run / VIEWS)
    view = record.viewpoints(None).views[0]
    focal_px = given.width * FOCAL_OF_WIDTH
    camera = PinholeCamera(
        given.width, given.height, focal_px, focal_px, given.width / 2, given.height / 2,
        view.rotation_cam_from_world, view.translation_cam_from_world,
    )  # fmt: skip
    aside = np.array([0.01 * record.extent_world, 0.0, 0.0])
    cameras = (camera, replace(camera, translation_cam_from_world=view.translation_cam_from_world - aside))
    scene = split(trained, given.gaussians)
    print(f"{len(scene):,} Gaussians of {len(trained):,}, {given.width} x {given.height} pixels")
    black = background_color("black")
    tracer = make_tracer(TraceSettings(), threads=given.threads, build_quality=2)
    tracer.build(trained)  # so that no kernel is compiled or loaded below
    render_rays(tracer, cameras[0].rays(), black)
    timed("tree", lambda: tracer.build(scene))

    def draw(number: int) -> RenderedImage:
        return render_rays(tracer, cameras[number].rays(), black)

    first = timed("first picture", lambda: draw(0))
    timed("next picture of a film", lambda: draw(1))
    timed("the first again", lambda: draw(0))
    if given.picture is not None:
        write_png(given.picture, first.rgb_srgb)


if __name__ == "__main__":
    main()
