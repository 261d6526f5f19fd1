"""``octasplat completion``: the script that makes a shell complete commands, options and values."""

import click
from click.shell_completion import get_completion_class

_WHERE = {
    "bash": "octasplat completion bash > ~/.local/share/bash-completion/completions/octasplat",
    "zsh": "octasplat completion zsh > ~/.zfunc/_octasplat   (with fpath+=~/.zfunc before compinit)",
    "fish": "octasplat completion fish > ~/.config/fish/completions/octasplat.fish",
}


@click.command(
    short_help="Print the completion script of a shell.",
    epilog="\b\nTo keep it:\n" + "\n".join(f"  {line}" for line in _WHERE.values()),
)
@click.argument("shell", type=click.Choice(list(_WHERE)))
@click.pass_context
def completion(ctx: click.Context, shell: str) -> None:
    """Print the script by which SHELL completes commands, options and their values with the Tab key."""
    made = get_completion_class(shell)
    assert made is not None
    script = made(ctx.find_root().command, {}, "octasplat", "_OCTASPLAT_COMPLETE")
    click.echo(script.source())
