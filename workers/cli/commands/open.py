"""``octasplat open``: the page of a service in a browser, signed in."""

import click

from octasplat.workers.cli.commands.client import connected, server_option


@click.command("open", short_help="Sign a browser in to the service.")
@click.option(
    "--print", "print_link", is_flag=True, help="Only print the link.  [default: without a display]"
)
@server_option
def open_page(print_link: bool, server: str | None) -> None:
    """Open the page in a browser, signed in with the token of octasplat serve, or of OCTASPLAT_TOKEN.

    The link that is printed without a display works once, within five minutes.
    """
    from octasplat.workers.cli.browser import has_display, open_signed_in, sign_in_link

    with connected(server) as api:
        if print_link or not has_display():
            click.echo(sign_in_link(api))
        else:
            open_signed_in(api)
