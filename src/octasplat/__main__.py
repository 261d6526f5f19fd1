"""The command ``octasplat``, also as ``python -m octasplat``."""

import click

from octasplat.workers.cli.main import cli, main


@click.command(short_help="Run the HTTP front end alone.")
@click.pass_context
def api(ctx: click.Context) -> None:
    """Run the HTTP front end alone, configured by the environment.

    The settings are in octasplat/service/settings.py, each given as OCTASPLAT_NAME. The address goes to
    standard output once requests are taken. On SIGTERM, requests in progress are finished and streams end.
    """
    from octasplat.service.serving import main as serve_api

    ctx.exit(serve_api())


cli.add_command(api)


if __name__ == "__main__":
    main()
