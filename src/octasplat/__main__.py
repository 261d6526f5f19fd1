"""The command ``octasplat``, also as ``python -m octasplat``."""

import webbrowser
from functools import partial
from pathlib import Path
from typing import Literal

import click

from octasplat.workers.cli.main import cli, main


@click.command(short_help="Run the HTTP front end alone.")
@click.pass_context
def api(ctx: click.Context) -> None:
    """Run the HTTP front end alone, configured by the environment.

    docs/service_settings.md lists the settings, each a variable such as OCTASPLAT_NAME. The address goes to
    standard output once requests are taken. On SIGTERM, requests in progress are finished and streams end.
    """
    from octasplat.service.serving import main as serve_api

    ctx.exit(serve_api())


@click.command(short_help="Show a scene in the browser, in 3D.")
@click.argument("source", metavar="IN", type=click.Path(path_type=Path))
@click.option(
    "--open/--no-open", "open_page", default=None, help="Open the page in a browser.  [default: on a desktop]"
)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=0,
    help="Port of the page.  [default: 0, which takes a free one]",
)
@click.option(
    "--background",
    type=click.Choice(["black", "white"]),
    default="black",
    show_default=True,
    help="Color behind the scene, to begin with.",
)
@click.option(
    "--shading",
    type=click.Choice(["materials", "harmonics"]),
    help="Colors of the Gaussians, to begin with: materials in the light that a run has learnt, or "
    "their harmonics.  [default: materials, of a run that has them]",
)
def view(
    source: Path,
    open_page: bool | None,
    port: int,
    background: str,
    shading: Literal["materials", "harmonics"] | None,
) -> None:
    """Show a scene in the browser: the folder of a run, or a file of any format.

    The page needs no service and no network: this command serves it, to browsers of this machine alone, until
    Ctrl-C. Of a run, one can go from photograph to photograph. Of a run in blocks that is not done yet, it
    shows what the blocks have learnt so far. A run with materials is shown with them, in its own light.
    """
    from octasplat.workers.cli.input_paths import check_readable

    check_readable(source)
    from octasplat.viewer import read_shown_scene, serve_scene
    from octasplat.workers.cli.browser import has_display
    from octasplat.workers.cli.progress import show_progress
    from octasplat.workers.cli.signals import exit_on_sigterm

    with show_progress() as progress:
        scene = read_shown_scene(source, progress)
    # SIGTERM unwinds the program here too, so that the temporary file of the scene is removed.
    served = partial(serve_scene, scene, source, port=port, background=background, shading=shading)
    with exit_on_sigterm(), served() as viewer:
        click.echo(f"Open {viewer.url} in a browser of this machine (Ctrl-C ends it).")
        if has_display() if open_page is None else open_page:
            webbrowser.open(viewer.url)
        try:
            viewer.wait()
        except KeyboardInterrupt:  # the usual end
            click.echo()


cli.add_command(api)
cli.add_command(view)


if __name__ == "__main__":
    main()
