"""``octasplat demo``: the whole way on a scene that octasplat makes itself."""

from pathlib import Path
from typing import Any

import click

from octasplat.engine.train.preset_names import PRESETS
from octasplat.workers.cli.browsing import has_display
from octasplat.workers.cli.options import quiet_option, threads_option

DEFAULT_OUTPUT = Path("octasplat-demo")


@click.command(short_help="Try everything on a generated scene.")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    default=DEFAULT_OUTPUT,
    show_default=True,
    help="Folder for the scene and the result.",
)
@click.option("--scene-only", is_flag=True, help="Only write the scene, right into the output folder.")
@click.option(
    "--preset",
    type=click.Choice(PRESETS),
    default="fast",
    show_default=True,
    help="Settings of the reconstruction.",
)
@click.option("--views", type=int, metavar="N", help="Number of photographs.")
@click.option("--width", type=int, metavar="PX", help="Width of the photographs.")
@click.option("--height", type=int, metavar="PX", help="Height of the photographs.")
@click.option(
    "--open/--no-open", "open_report", default=None, help="Open the report in a browser at the end."
)
@threads_option
@quiet_option
def demo(output: Path, open_report: bool | None, **options: Any) -> None:
    """Make photographs of a still life, reconstruct them and open the report; takes a few minutes.

    The same command goes on where it was interrupted.
    """
    from octasplat.workers.cli.demonstration import make_scene, reconstruct_scene

    size = {"views": options["views"], "width_px": options["width"], "height_px": options["height"]}
    quiet, threads = options["quiet"], options["threads"]
    if options["scene_only"]:
        make_scene(output, size, quiet=quiet)
        click.echo(f"The scene is in {output}; reconstruct it with: octasplat reconstruct {output} -o OUT")
        return
    make_scene(output / "scene", size, quiet=quiet)
    report = reconstruct_scene(
        output / "scene", output / "result", options["preset"], threads=threads, quiet=quiet
    )
    click.echo(f"Open {report} in a browser to see the result.")
    if has_display() if open_report is None else open_report:
        import webbrowser

        webbrowser.open(report.resolve().as_uri())
