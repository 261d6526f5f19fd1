"""``octasplat relight``: a scene with materials in other light."""

from pathlib import Path
from typing import Any

import click

from octasplat.workers.cli.camera_options import AXES, camera_options, check_cameras, check_output
from octasplat.workers.cli.options import quiet_option, threads_option


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
    type=click.Choice(["split-sum", "path"]),
    default="split-sum",
    show_default=True,
    help="Fast, as in training, with traced visibility; or right, by paths of light.",
)
@click.option(
    "--samples",
    type=click.IntRange(1, 65536),
    help="Rays or paths a pixel.  [default: 4 rays of the split sum, 64 paths]",
)
@click.option("--depth", type=click.IntRange(1, 64), default=6, show_default=True, help="Surfaces on a path.")
@click.option("--rotate", type=float, default=0.0, metavar="DEG", help="Turn the light about the vertical.")
@click.option(
    "--clamp",
    type=click.FloatRange(0, min_open=True),
    metavar="MOST",
    help="Cut the light of the maps off at this radiance: fewer bright specks by paths, and weaker lamps.",
)
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
@camera_options
@click.option(
    "--up", type=click.Choice(AXES), help="The axis that points up.  [default: the run's, of a file -y]"
)
@click.option("--exr", is_flag=True, help="Write EXR with linear RGB and A instead of PNG.")
@click.option(
    "--background",
    type=click.Choice(["black", "white", "transparent", "environment"]),
    help="Behind the scene; transparent gives alpha.  [default: that of the run's evaluation, or black]",
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
    modes = [name for name in ("views", "on", "turntable", "camera_path", "camera") if options[name]]
    if len(modes) > 1:
        raise click.UsageError("Choose one of --views, --on, --turntable, --path and --camera.")
    if options["frames"] and options["seconds"]:
        raise click.UsageError("Choose one of --frames and --seconds.")
    from octasplat.engine.run_folder import is_run

    of_run = is_run(options["source"])
    mode = modes[0] if modes else "views" if of_run else "turntable"
    if mode == "views" and not of_run:
        raise click.UsageError("--views needs the folder of a run; a file has --on, --turntable and --path.")
    if mode in ("views", "on") and options["output"].suffix.lower() == ".mp4":
        raise click.UsageError(f"--{mode} gives images; name a folder.")
    if options["background"] == "transparent" and options["output"].suffix.lower() == ".mp4":
        raise click.UsageError("A video has no alpha; name a folder, or another --background.")
    check_cameras(mode, options)
    one = mode == "camera" or (mode == "turntable" and options["frames"] == 1)
    single = one and len(options["environment"]) == 1
    check_output(options["output"], options["exr"], single=single, known=mode == "turntable")

    from octasplat.engine.errors import Cancelled
    from octasplat.engine.stages import stopping
    from octasplat.workers.cli.progress import show_progress
    from octasplat.workers.cli.scene_files import speaker_of_losses
    from octasplat.workers.cli.signals import Stopped, stop_on_signals
    from octasplat.workers.rendering.relighting import relight_files
    from octasplat.workers.rendering.views import Keeping

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
