"""``octasplat relight``: a scene with materials in other light."""

from pathlib import Path
from typing import Any

import click

from workers.cli.commands.render import AXES, check_output
from workers.cli.options import quiet_option, threads_option


@click.command(short_help="A scene with materials in other light.")
@click.argument("source", metavar="IN", type=click.Path(path_type=Path))
@click.option(
    "--environment",
    type=click.Path(path_type=Path),
    multiple=True,
    required=True,
    metavar="MAP",
    help="Equirectangular HDR or EXR image; several are done one after another.",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    required=True,
    help="A folder, a pattern such as frames/%04d.png (or .exr), or a film such as turn.mp4.",
)
@click.option(
    "--by",
    type=click.Choice(["path"]),
    default="path",
    show_default=True,
    help="Fast, as in training, with traced visibility; or right, by paths of light.",
)
@click.option(
    "--samples", type=click.IntRange(1, 65536), default=64, show_default=True, help="Paths a pixel."
)
@click.option("--depth", type=click.IntRange(1, 64), default=6, show_default=True, help="Surfaces on a path.")
@click.option("--rotate", type=float, default=0.0, metavar="DEG", help="Turn the light about the vertical.")
@click.option("--spin", is_flag=True, help="Turn the light once round from the first image to the last.")
@click.option(
    "--views",
    type=click.Choice(["held-out", "train", "all"]),
    help="The views of the photographs; IN must be a run.",
)
@click.option(
    "--on",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="The views of the photographs of another folder (images/ and sparse/0).",
)
@click.option("--turntable", is_flag=True, help="One turn round the scene.")
@click.option(
    "--path",
    "camera_path",
    type=click.Path(path_type=Path),
    help="The cameras of a JSON file; docs/cameras.md tells its format.",
)
@click.option("--frames", type=click.IntRange(min=1), help="Turntable: number of images.  [default: 120]")
@click.option("--seconds", type=click.FloatRange(0, min_open=True), help="Turntable: duration instead.")
@click.option("--fps", type=click.FloatRange(0, min_open=True), help="Images per second.  [default: 30]")
@click.option("--width", type=click.IntRange(16, 16384), default=640, show_default=True, help="Turntable.")
@click.option("--height", type=click.IntRange(16, 16384), default=480, show_default=True, help="Turntable.")
@click.option("--fov", type=click.FloatRange(1, 170), help="Turntable: angle from top to bottom, degrees.")
@click.option(
    "--up", type=click.Choice(AXES), help="The axis that points up.  [default: the run's, of a file -y]"
)
@click.option("--exr", is_flag=True, help="Write EXR with linear RGB and A instead of PNG.")
@click.option(
    "--background",
    type=click.Choice(["black", "white", "environment"]),
    help="Behind the scene.  [default: that of the run's evaluation, or black]",
)
@click.option(
    "--max-side", type=click.IntRange(min=16), metavar="PX", help="Views: longer side of the images."
)
@click.option(
    "--scene",
    type=click.Path(path_type=Path),
    help="Take the cameras of the photographs in this folder.  [default: those the run keeps]",
)
@click.option("--resume", is_flag=True, help="Go on where this was stopped, if it was.")
@threads_option
@quiet_option
def relight(**options: Any) -> None:
    """Show IN, the folder of a run with materials or a file of Gaussians that has them, in other light.

    Without --views, --on, --turntable or --path: the held-out views of a run, a turntable of a file. Of
    several environments each has a folder of its name, or its turn in one film.
    """
    modes = [name for name in ("views", "on", "turntable", "camera_path") if options[name]]
    if len(modes) > 1:
        raise click.UsageError("Choose one of --views, --on, --turntable and --path.")
    if options["frames"] and options["seconds"]:
        raise click.UsageError("Choose one of --frames and --seconds.")
    from engine.run_folder import is_run

    of_run = is_run(options["source"])
    mode = modes[0] if modes else "views" if of_run else "turntable"
    if mode == "views" and not of_run:
        raise click.UsageError("--views needs the folder of a run; a file has --on, --turntable and --path.")
    if mode in ("views", "on") and options["output"].suffix.lower() == ".mp4":
        raise click.UsageError(f"--{mode} gives images; name a folder.")
    check_output(options["output"], options["exr"])

    from engine.errors import Cancelled
    from engine.stages import stopping
    from workers.cli.progress import show_progress
    from workers.cli.scene_files import speaker_of_losses
    from workers.cli.signals import Stopped, stop_on_signals
    from workers.rendering.relighting import relight_files
    from workers.rendering.views import Keeping

    quiet = options["quiet"]
    with stop_on_signals() as should_stop:
        try:
            with show_progress(quiet=quiet, should_stop=should_stop) as listener:
                tell = stopping(listener, should_stop)
                keeping = Keeping(resume=options["resume"])
                files = relight_files(mode, options, tell, speaker_of_losses(quiet), keeping)
        except Cancelled as error:
            raise Stopped(str(error), should_stop.exit_code) from None
    if not quiet:
        click.echo(f"Wrote {files[0]}" + (f" and {len(files) - 1} more." if len(files) > 1 else "."))
