"""``octasplat render``: new views of a scene, as images or a video."""

from pathlib import Path
from typing import Any

import click

from workers.cli.options import background_option, quiet_option, threads_option

PREVIEW_SIDE_PX = 480
AXES = ("x", "-x", "y", "-y", "z", "-z")


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
    "--up", type=click.Choice(AXES), help="Turntable of a file: the axis that points up.  [default: -y]"
)
@click.option("--exr", is_flag=True, help="Write EXR with linear RGB, A, Z and normals instead of PNG.")
@background_option("Behind the scene.  [default: that of the run's evaluation, or black]")
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
@click.option("--preview", is_flag=True, help="Stage: the first image only, -o one file, finer and finer.")
@click.option(
    "--layers", is_flag=True, help="Stage: EXR files with background, shadow and things, for a compositor."
)
@click.option("--denoise", is_flag=True, help="Stage: take the noise from what light brings.")
@threads_option
@quiet_option
def render(**options: Any) -> None:
    """Render new views of IN, the folder of a run or a file of Gaussians in any splat format.

    Without --views, --turntable or --path: the held-out views of a run, a turntable of a file.
    """
    modes = [name for name in ("views", "turntable", "camera_path") if options[name]]
    if len(modes) > 1:
        raise click.UsageError("Choose one of --views, --turntable and --path.")
    if options["frames"] and options["seconds"]:
        raise click.UsageError("Choose one of --frames and --seconds.")
    from engine.run_folder import is_run

    of_run = is_run(options["source"])
    mode = modes[0] if modes else "views" if of_run else "turntable"
    if mode == "views" and not of_run:
        raise click.UsageError("--views needs the folder of a run; a file has --turntable and --path.")
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
        _check_output(options["output"], options["exr"])

    from workers.cli.progress import show_progress
    from workers.cli.scene_files import speaker_of_losses
    from workers.cli.signals import orderly_termination
    from workers.rendering.views import render_files

    quiet = options["quiet"]
    with orderly_termination(), show_progress(quiet=quiet) as listener:
        files = render_files(mode, options, listener, speaker_of_losses(quiet))
    if not quiet:
        click.echo(f"Wrote {files[0]}" + (f" and {len(files) - 1} more." if len(files) > 1 else "."))


def _check_output(output: Path, exr: bool) -> None:
    """Refuse names that say something else than what would be written."""
    suffix = output.suffix.lower()
    if suffix == ".mp4" and exr:
        raise click.UsageError("--exr gives images; name a folder instead of a video.")
    if suffix in (".png", ".exr"):
        try:
            numbered = output.name % 0 != output.name % 1
        except (TypeError, ValueError):
            numbered = False
        if not numbered:
            raise click.UsageError(f"{output} names one image; write a pattern such as frame_%04d{suffix}.")
        if exr and suffix == ".png":
            raise click.UsageError("--exr and a pattern for .png contradict each other.")
