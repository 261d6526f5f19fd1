"""``octasplat render``: new views of a scene, as images or a video."""

from pathlib import Path
from typing import Any

import click

from engine.render.names import names_by_number
from workers.cli.options import quiet_option, threads_option

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
@click.option(
    "--camera",
    nargs=3,
    type=float,
    metavar="X Y Z",
    help="One image from this place, looking at --look-at or the middle of the scene; -o names its file.",
)
@click.option(
    "--look-at", nargs=3, type=float, metavar="X Y Z", help="Turntable, camera: the point that is looked at."
)
@click.option(
    "--distance", type=click.FloatRange(0, min_open=True), help="Turntable: from that point, in scene units."
)
@click.option(
    "--elevation",
    type=click.FloatRange(-89, 89),
    help="Turntable: of the camera above that point, degrees.  [default: as photographed, or 20]",
)
@click.option("--frames", type=click.IntRange(min=1), help="Turntable: number of images.  [default: 120]")
@click.option("--seconds", type=click.FloatRange(0, min_open=True), help="Turntable: duration instead.")
@click.option("--fps", type=click.FloatRange(0, min_open=True), help="Images per second.  [default: 30]")
@click.option(
    "--width",
    type=click.IntRange(16, 16384),
    default=640,
    show_default=True,
    help="Of a turntable's or a camera's images.",
)
@click.option("--height", type=click.IntRange(16, 16384), default=480, show_default=True, help="The same.")
@click.option(
    "--fov", type=click.FloatRange(1, 170), help="Turntable, camera: angle from top to bottom, degrees."
)
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
    from engine.run_folder import is_run

    of_run = is_run(options["source"])
    mode = modes[0] if modes else "views" if of_run else "turntable"
    _check_cameras(mode, options)
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
        _check_output(options["output"], options["exr"], single=single, known=mode == "turntable")

    from engine.errors import Cancelled
    from engine.light.stage_file import read_stage
    from engine.stages import stopping
    from workers.cli.progress import show_progress
    from workers.cli.scene_files import speaker_of_losses
    from workers.cli.signals import Stopped, stop_on_signals
    from workers.rendering.views import Keeping, SetStage, render_files

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


def _check_cameras(mode: str, options: dict[str, Any]) -> None:
    """Refuse options of a turntable or camera where there is none."""
    if mode in ("views", "camera_path"):
        given = [name for name in ("look_at", "distance", "elevation") if options[name] is not None]
        if given:
            name = "--" + given[0].replace("_", "-")
            raise click.UsageError(f"{name} goes with --turntable or --camera.")
    if mode == "camera" and (options["distance"] is not None or options["elevation"] is not None):
        raise click.UsageError("--camera says where the camera stands; leave out --distance and --elevation.")


def _check_output(output: Path, exr: bool, *, single: bool, known: bool) -> None:
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
