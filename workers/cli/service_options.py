"""Options and connection of the commands that talk to a service."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    from octasplat.workers.client.api import Api

F = TypeVar("F", bound=Callable[..., Any])


class SceneName(click.Path):
    """A scene: a path, or the address of a ZIP file or of a folder in a bucket, which stays text."""

    name = "scene"

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path, or the address."""
        from octasplat.workers.client.bucket import is_bucket_address
        from octasplat.workers.client.dataset_tasks import is_web_address

        is_address = is_web_address(value) or is_bucket_address(value)
        return value if is_address else super().convert(value, param, ctx)


def server_option(command: F) -> F:
    """Add the option ``--server`` to a command."""
    return click.option(
        "--server",
        metavar="URL",
        help="The service.  [default: OCTASPLAT_SERVER, or octasplat serve of this machine]",
    )(command)


def set_option(command: F) -> F:
    """Add the option ``--set`` to a command."""
    return click.option(
        "--set",
        multiple=True,
        metavar="NAME=VALUE",
        help="An option of the job's kind, or of a reconstruction any setting, e.g. lr.quat=0.02, values as "
        "JSON; may be repeated.",
    )(command)


def wait_options(command: F) -> F:
    """Add the options ``--wait`` and ``--output`` to a command that queues a job."""
    for option in (
        click.option(
            "-o", "--output", type=click.Path(path_type=Path), help="With --wait: folder for the results."
        ),
        click.option("--wait", is_flag=True, help="Show the progress and save the results at the end."),
    ):
        command = option(command)
    return command


def job_options(command: F) -> F:
    """Add ``--label``, ``--queue`` and ``--priority`` of a new job, and ``--server``, to a command."""
    for option in (
        server_option,
        click.option(
            "--priority",
            type=click.IntRange(-100, 100),
            default=0,
            help="Among your jobs, higher goes first.",
        ),
        click.option("--queue", default="cpu", show_default=True, help="Which workers."),
        click.option("--label", help="What to call the job."),
    ):
        command = option(command)
    return command


def limit_option(command: F) -> F:
    """Add the option ``--limit`` of lists to a command."""
    return click.option(
        "--limit", type=click.IntRange(1, 1000), default=20, show_default=True, metavar="N",
        help="Most rows to list.",
    )(command)  # fmt: skip


@contextmanager
def connected(server: str | None, *, awaits_start: bool = False) -> Iterator["Api"]:
    """Yield the service that the user means; the token is no option, as others on a machine see those.

    Args:
        server: its address; None for that of the environment or of this machine.
        awaits_start: whether the command waits for a service that is being started again, as long work does;
            else a refused connection is told at once.
    """
    from octasplat.workers.client.api import Api, find_address, find_token

    address = server or find_address(os.environ)
    with Api(address, find_token(os.environ, address), awaits_start=awaits_start) as api:
        yield api
