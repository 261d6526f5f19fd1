"""Options of what renders turntables, paths and single images, and what of them goes together."""

from pathlib import Path
from typing import Any

import click

from octasplat.engine.render.names import names_by_number
from octasplat.workers.cli.options import F

AXES = ("x", "-x", "y", "-y", "z", "-z")

_OPTIONS = (
    click.option("--turntable", is_flag=True, help="One turn round the scene."),
    click.option(
        "--path",
        "camera_path",
        type=click.Path(path_type=Path),
        help="The cameras of a JSON file; docs/cameras.md tells its format.",
    ),
    click.option(
        "--camera",
        nargs=3,
        type=float,
        metavar="X Y Z",
        help="One image from this place, looking at --look-at or the middle of the scene; -o names it.",
    ),
    click.option(
        "--look-at",
        nargs=3,
        type=float,
        metavar="X Y Z",
        help="Turntable, camera: the point that is looked at.",
    ),
    click.option(
        "--distance",
        type=click.FloatRange(0, min_open=True),
        help="Turntable: from that point, in scene units.",
    ),
    click.option(
        "--elevation",
        type=click.FloatRange(-89, 89),
        help="Turntable: of the camera above that point, degrees.  [default: as photographed, or 20]",
    ),
    click.option("--frames", type=click.IntRange(min=1), help="Turntable: number of images.  [default: 120]"),
    click.option("--seconds", type=click.FloatRange(0, min_open=True), help="Turntable: duration instead."),
    click.option("--fps", type=click.FloatRange(0, min_open=True), help="Images per second.  [default: 30]"),
    click.option(
        "--width",
        type=click.IntRange(16, 16384),
        default=640,
        show_default=True,
        help="Of a turntable's or a camera's images.",
    ),
    click.option(
        "--height", type=click.IntRange(16, 16384), default=480, show_default=True, help="The same."
    ),
    click.option(
        "--fov", type=click.FloatRange(1, 170), help="Turntable, camera: angle from top to bottom, degrees."
    ),
)


def camera_options(command: F) -> F:
    """``--turntable``, ``--path``, ``--camera``, and how they are set."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def check_cameras(mode: str, options: dict[str, Any]) -> None:
    """Refuse options of a turntable or camera where there is none."""
    if mode in ("views", "camera_path"):
        given = [name for name in ("look_at", "distance", "elevation") if options[name] is not None]
        if given:
            name = "--" + given[0].replace("_", "-")
            raise click.UsageError(f"{name} goes with --turntable or --camera.")
    if mode == "camera" and (options["distance"] is not None or options["elevation"] is not None):
        raise click.UsageError("--camera says where the camera stands; leave out --distance and --elevation.")


def check_output(output: Path, exr: bool, *, single: bool, known: bool) -> None:
    """Refuse names that say something else than what would be written.

    ``single`` means that there is one image, ``known`` that there are surely several otherwise.
    """
    suffix = output.suffix.lower()
    if suffix == ".mp4" and (exr or single):
        what = "--exr gives images" if exr else "There is one image"
        raise click.UsageError(f"{what}; name a folder or an image instead of a video.")
    if suffix in (".png", ".exr"):
        if known and not single and not names_by_number(output):
            raise click.UsageError(f"{output} names one image; write a pattern such as frame_%04d{suffix}.")
        if exr and suffix == ".png":
            raise click.UsageError("--exr and the name of a .png contradict each other.")
