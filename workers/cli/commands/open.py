"""``octasplat open``: the page of a service in a browser, signed in."""

import click

from octasplat.workers.cli.printing import Printer, output_options
from octasplat.workers.cli.service_options import connected, server_option


@click.command("open", short_help="Sign a browser in to the service.")
@click.option(
    "--print",
    "print_link",
    is_flag=True,
    help="Only print the link.  [default: without a display or browser]",
)
@server_option
@output_options
def open_page(print_link: bool, server: str | None, printer: Printer) -> None:
    """Open the page in a browser, signed in with the token of octasplat serve, or of OCTASPLAT_TOKEN.

    The link that is printed otherwise works once, within five minutes.
    """
    from octasplat.workers.cli.browser import has_display, open_signed_in, sign_in_link

    with connected(server) as api:
        if print_link or printer.as_json or not has_display() or not open_signed_in(api):
            link = sign_in_link(api)  # another one where a browser was not started
            printer.print({"link": link}, [link], quiet_lines=[link])
