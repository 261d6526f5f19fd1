"""``octasplat render``: new views of a scene, as images or a video."""

from pathlib import Path
from typing import Any

import click

from octasplat.workers.cli.camera_options import AXES, camera_options, check_cameras, check_output
from octasplat.workers.cli.options import quiet_option, threads_option

PREVIEW_SIDE_PX = 480


@click.command(short_help="New views of a scene as images or a video.")
@click.argument("source", metavar="IN", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    required=True,
    help="A folder, a pattern such as frames/%04d.png (or .exr), or a video such as turn.mp4.",
)
@click.option(
    "--views",
    type=click.Choice(["held-out", "train", "all"]),
    help="The views of the photographs; IN must be a run.",
)
@camera_options
@click.option("--up", type=click.Choice(AXES), help="The axis of a file that points up.  [default: -y]")
@click.option("--exr", is_flag=True, help="Write EXR with linear RGB, A, Z and normals instead of PNG.")
@click.option(
    "--background",
    type=click.Choice(["black", "white", "transparent"]),
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
@click.option(
    "--stage",
    type=click.Path(path_type=Path),
    metavar="STAGE.toml",
    help="Render with the meshes, lights and materials of a stage, see docs/light.md.",
)
@click.option("--resume", is_flag=True, help="Go on with a render that was stopped, if there is one.")
@click.option("--preview", is_flag=True, help="Stage: the first image only, -o one file, finer and finer.")
@click.option(
    "--layers", is_flag=True, help="Stage: EXR files with background, shadow and things, for a compositor."
)
@click.option("--denoise", is_flag=True, help="Stage: take the noise from what light brings.")
@threads_option
@quiet_option
def render(**options: Any) -> None:
    """Render new views of IN, the folder of a run or a file of Gaussians in any splat format.

    Without --views, --turntable or --path: the held-out views of a run, a turntable of a file. Ctrl-C stops
    after the image under way has come to a safe point; the same command with --resume goes on.
    """
    modes = [name for name in ("views", "turntable", "camera_path", "camera") if options[name]]
    if len(modes) > 1:
        raise click.UsageError("Choose one of --views, --turntable, --path and --camera.")
    if options["frames"] and options["seconds"]:
        raise click.UsageError("Choose one of --frames and --seconds.")
    from octasplat.engine.run_folder import is_run

    of_run = is_run(options["source"])
    mode = modes[0] if modes else "views" if of_run else "turntable"
    check_cameras(mode, options)
    if mode == "views" and not of_run:
        raise click.UsageError("--views needs the folder of a run; a file has --turntable and --path.")
    if options["background"] == "transparent":
        if options["stage"] is not None:
            raise click.UsageError("A stage is transparent in .exr only, which has alpha on any background.")
        if options["output"].suffix.lower() == ".mp4":
            raise click.UsageError("A video has no alpha; name a folder, or another --background.")
    if mode == "views" and options["output"].suffix.lower() == ".mp4":
        raise click.UsageError("--views gives images; name a folder.")
    if options["stage"] is None and (options["layers"] or options["denoise"]):
        raise click.UsageError("--layers and --denoise go with --stage.")
    if options["preview"]:
        if options["stage"] is None or options["output"].suffix.lower() not in (".png", ".exr"):
            raise click.UsageError(
                "--preview goes with --stage and writes one .png or .exr; name it with -o."
            )
        options["max_side"] = options["max_side"] or PREVIEW_SIDE_PX
    else:
        single = mode == "camera" or (mode == "turntable" and options["frames"] == 1)
        check_output(options["output"], options["exr"], single=single, known=mode == "turntable")

    from octasplat.engine.errors import Cancelled
    from octasplat.engine.light.stage_file import read_stage
    from octasplat.engine.stages import stopping
    from octasplat.workers.cli.progress import show_progress
    from octasplat.workers.cli.scene_files import speaker_of_losses
    from octasplat.workers.cli.signals import Stopped, stop_on_signals
    from octasplat.workers.rendering.views import Keeping, SetStage, render_files

    path, quiet = options["stage"], options["quiet"]
    say = speaker_of_losses(quiet)
    with stop_on_signals() as should_stop:
        try:
            with show_progress(quiet=quiet, should_stop=should_stop) as listener:
                stage = None if path is None else SetStage(read_stage(path), path.parent)
                told = "Stopped; the preview is as fine as it was." if options["preview"] else None
                tell = stopping(listener, should_stop, told)
                files = render_files(mode, options, tell, say, stage, Keeping(resume=options["resume"]))
        except Cancelled as error:
            raise Stopped(str(error), should_stop.exit_code) from None
    if not quiet:
        click.echo(f"Wrote {files[0]}" + (f" and {len(files) - 1} more." if len(files) > 1 else "."))
