"""``octasplat verbs``: what octasplat does, as commands, jobs and Python calls."""

import json
from dataclasses import asdict

import click


@click.command(short_help="The verbs as commands, jobs and Python calls.")
@click.option("--markdown", is_flag=True, help="Write the page docs/verbs.md.")
@click.option("--json", "as_json", is_flag=True, help="Write JSON.")
def verbs(markdown: bool, as_json: bool) -> None:
    """List what octasplat does, each verb as a command, a kind of job and a call in Python."""
    from octasplat.workers.cli.verbs import verbs, verbs_page

    if markdown:
        click.echo(verbs_page(), nl=False)
        return
    if as_json:
        click.echo(json.dumps([asdict(verb) for verb in verbs()], indent=2))
        return
    for verb in verbs():
        click.echo(f"{verb.name:12} {verb.title}")
        for label, text in (("Command", verb.command), ("HTTP", verb.http), ("Python", verb.python)):
            if text:
                click.echo(f"{'':12} {label}: {text}")
