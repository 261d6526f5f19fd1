"""The command ``octasplat``: photographs to scenes, meshes, measurements and new views.

Everything heavy is imported by the commands when they run, so that ``--help`` answers at once.
"""

import errno
import io
import os
import sys
import traceback
import warnings
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn, TextIO

import click

from octasplat.engine.core.errors import OctasplatError
from octasplat.workers.cli.collector import rare_collections
from octasplat.workers.cli.signals import StoppedError

# Threads that wait for each other sleep instead of spinning: no slower alone, several times faster on a
# shared machine. Must be set before OpenMP is loaded; an explicit setting wins.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

DEBUG = "OCTASPLAT_DEBUG"
EXIT_UNEXPECTED = 70
EXIT_INTERRUPTED = 130
_POSIX_MODULES = frozenset({"fcntl", "grp", "pwd", "resource"})
_NEEDS_POSIX = (
    "This command needs Linux or macOS; on Windows run it under WSL, or send the work to a service with "
    "octasplat submit."
)


_SECTIONS: dict[str, dict[str, tuple[str, str]]] = {
    "From photographs to a scene": {
        "demo": ("demo", "Try everything on a generated scene."),
        "estimate": ("estimate", "Estimate what a reconstruction takes, before it is begun."),
        "plan": ("plan", "Plan the blocks of a large capture: how many, their time and memory."),
        "reconstruct": ("reconstruct", "Photographs to a scene, its meshes, and measurements."),
        "evaluate": ("evaluate", "Measure a finished run again."),
    },
    "Look at a scene": {
        "view": ("", "Show a scene in the browser, in 3D."),
        "info": ("info", "Describe what is in a scene: counts, bounds, sizes, cost."),
        "render": ("render", "Render new views of a scene as images or a video."),
        "relight": ("relight", "Show a scene with materials in other light."),
    },
    "Take a scene to other programs": {
        "export": ("export", "Gaussians to meshes and other formats."),
        "surface": ("surface", "One colored triangle mesh of a scene."),
        "import": ("import_", "Splats of any format to a scene of flat Gaussians."),
    },
    "Change a scene": {
        "clean": ("clean", "Remove faint Gaussians, oversized ones and floaters."),
        "crop": ("crop", "Keep part of a scene."),
        "simplify": ("simplify", "Merge neighbors until so many Gaussians are left."),
        "transform": ("transform", "Move, turn or scale a scene."),
        "merge": ("merge", "Put scenes together."),
        "edit": ("edit", "Turn a mesh edited elsewhere back into Gaussians."),
        "deform": ("deform", "Make a scene follow a deformed cage or coarse mesh."),
        "material": ("material", "Change the materials of a scene."),
        "stage": ("stage", "Stages: things and lights put into a scene."),
    },
    "Work with a service": {
        "open": ("open", "Sign a browser in to the service."),
        "submit": ("submit", "Send photographs to the service and queue their reconstruction."),
        "derive": ("submit", "Queue a job on the results of a finished one, such as a render."),
        "jobs": ("service_jobs", "List jobs."),
        "status": ("service_jobs", "Show a job, or wait for it."),
        "logs": ("service_jobs", "Show the log of a job."),
        "cancel": ("service_jobs", "Stop a job."),
        "retry": ("submit", "Queue a failed or cancelled job again."),
        "download": ("service_jobs", "Save the results of a job."),
        "usage": ("usage", "Show what you have stored and what you may."),
        "datasets": ("service_jobs", "List datasets, which hold the photographs of jobs."),
        "workers": ("service_jobs", "List queues and the workers that take jobs from them."),
    },
    "Run a service": {
        "serve": ("serve", "Run the whole service on this machine."),
        "api": ("", "Run the HTTP front end alone."),
        "worker": ("worker", "Take jobs from the queue of a service."),
        "pause": ("hold", "Let a queue hand out no jobs."),
        "unpause": ("hold", "Let a paused queue hand out jobs again."),
        "drain": ("hold", "Let a worker finish what it has and take nothing new."),
        "undrain": ("hold", "Let a drained worker take jobs again."),
        "token": ("token", "Who may use the service."),
        "quota": ("quota", "Show or set what an owner may take."),
        "migrate": ("migrate", "Bring a database to this version's tables."),
        "backup": ("backup", "Copy a service, tables and store, while it runs."),
        "restore": ("backup", "Put a backup into an empty service."),
        "fsck": ("fsck", "Compare the tables of a service with its store."),
    },
    "About the program": {
        "config": ("config", "The settings of a reconstruction: list, explain, compare."),
        "verbs": ("verbs", "The verbs as commands, jobs and Python calls."),
        "warm-up": ("warm_up", "Compile everything that the first use would wait for."),
        "completion": ("completion", "Print the completion script of a shell."),
    },
}
"""Each command by what one wants to do: its module in :mod:`octasplat.workers.cli.commands`, imported when
the command runs, and its line in the help. Those without a module are added where they are defined."""

_COMMANDS = {name: entry for section in _SECTIONS.values() for name, entry in section.items() if entry[0]}


def has_command(name: str) -> bool:
    """Return whether there is a command of that name."""
    return name in _COMMANDS


class _LazyGroup(click.Group):
    """A group that imports a command when it is called.

    Commands end with one sentence and an exit code, never with a traceback.
    """

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands."""
        return sorted({*_COMMANDS, *self.commands})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return the command of that name, imported now; None if there is none."""
        if cmd_name not in _COMMANDS:
            return super().get_command(ctx, cmd_name)
        with rare_collections():
            module = import_module(f"octasplat.workers.cli.commands.{_COMMANDS[cmd_name][0]}")
        commands = (value for value in vars(module).values() if isinstance(value, click.Command))
        return next(command for command in commands if command.name == cmd_name)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands by what one wants to do, without importing them."""
        known = set(self.list_commands(ctx))
        for title, section in _SECTIONS.items():
            with formatter.section(title):
                formatter.write_dl([(name, text) for name, (_, text) in section.items() if name in known])

    def invoke(self, ctx: click.Context) -> Any:
        """Run the chosen command."""
        try:
            return super().invoke(ctx)
        except (click.ClickException, click.exceptions.Exit, click.Abort):
            raise
        except StoppedError as error:
            click.echo(str(error), err=True)
            ctx.exit(error.exit_code)
        except OctasplatError as error:
            _fail(ctx, str(error), 1)
        except KeyboardInterrupt:
            _fail(ctx, "Interrupted.", EXIT_INTERRUPTED)
        except Exception as error:
            if isinstance(error, OSError) and error.errno == errno.EPIPE:
                raise  # whoever read the output has left, which click treats well
            if isinstance(error, ModuleNotFoundError) and error.name in _POSIX_MODULES:
                _fail(ctx, _NEEDS_POSIX, 1)
            if os.environ.get(DEBUG) == "1":
                traceback.print_exc()
            text = f"{type(error).__name__}: {error} (unexpected; run with {DEBUG}=1 for details)"
            _fail(ctx, text, EXIT_UNEXPECTED)


def _fail(ctx: click.Context, message: str, exit_code: int) -> NoReturn:
    """End the program with one line on stderr."""
    click.echo(f"Error: {' '.join(message.split())}", err=True)
    ctx.exit(exit_code)


def _show_versions(context: click.Context, _parameter: click.Parameter, is_asked: bool) -> None:
    """Print the versions that results depend on, and what the processor can do."""
    if not is_asked or context.resilient_parsing:
        return
    from octasplat.workers.cli.versions import version_lines

    for line in version_lines():
        click.echo(line)
    context.exit()


@click.group(
    cls=_LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100}
)
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_show_versions,
    help="Show the versions that matter for results, and exit.",
)
def cli() -> None:
    """Reconstruct scenes of flat Gaussians from photographs, on an ordinary CPU.

    Try it without photographs: octasplat demo
    """


@cache
def _echo_once(text: str) -> None:
    """Print a line on stderr, unless it was printed before."""
    click.echo(text, err=True)


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Show a warning that is meant for users as one sentence, another as Python does."""
    if issubclass(category, FutureWarning):
        _echo_once(f"Warning: {message}")
    else:
        (file or sys.stderr).write(warnings.formatwarning(message, category, filename, lineno, line))


def _open_missing_streams() -> None:
    """Let standard streams that the caller has closed lead nowhere.

    Else the next file that is opened takes the place of one, and native libraries print into it.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            # the lowest descriptor that is free, which is the closed one
            setattr(sys, name, Path(os.devnull).open(mode, encoding="utf-8"))  # noqa: SIM115 (open until the end)


def _show_any_text() -> None:
    """Let standard output show what its encoding lacks, such as the name of a file, as escapes."""
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")


def main() -> None:
    """Run the command line; warnings for users are one sentence."""
    _open_missing_streams()
    _show_any_text()
    warnings.showwarning = _show_warning
    cli(prog_name="octasplat")
