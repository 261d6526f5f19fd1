"""``octasplat verbs``: what octasplat does, as commands, jobs and Python calls."""

import click

from octasplat.workers.cli.printing import Printer, output_options


@click.command(short_help="The verbs as commands, jobs and Python calls.")
@click.option("--markdown", is_flag=True, help="Write the page docs/verbs.md.")
@output_options
def verbs(markdown: bool, printer: Printer) -> None:
    """List what octasplat does, each verb as a command, a kind of job and a call in Python."""
    from octasplat.workers.cli.verbs import verbs, verbs_page

    if markdown:
        click.echo(verbs_page(), nl=False)
        return
    lines = []
    for verb in verbs():
        lines.append(f"{verb.name:12} {verb.title}")
        for label, text in (("Command", verb.command), ("HTTP", verb.http), ("Python", verb.python)):
            if text:
                lines.append(f"{'':12} {label}: {text}")
    printer.print(verbs(), lines, quiet_lines=[verb.name for verb in verbs()])
