"""What commands print: text for people, JSON for programs, or nothing but warnings."""

import functools
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, TypeVar

import click
from pydantic_core import PydanticSerializationError, to_json, to_jsonable_python

from octasplat.engine.core.errors import OutputError
from octasplat.engine.operations.base import Result

F = TypeVar("F", bound=Callable[..., Any])


@dataclass(frozen=True)
class Printer:
    """Prints the outcome of a command as text or JSON.

    Attributes:
        as_json: one JSON value on standard output, and nothing else there.
        quiet: no progress and no sentences; of lists, the ids or names alone.
    """

    as_json: bool = False
    quiet: bool = False

    @property
    def hides_progress(self) -> bool:
        """Return whether progress and sentences are left out."""
        return self.quiet or self.as_json

    def print(self, value: Any, lines: Iterable[str], *, quiet_lines: Iterable[str] = ()) -> None:
        """Print a value.

        Args:
            value: a result, a model, or JSON values.
            lines: the same for people.
            quiet_lines: what is left of it with ``--quiet``.

        Raises:
            OutputError: standard output cannot be written.
        """
        if self.as_json:
            _echo(json_text(value.facts() if isinstance(value, Result) else value))
            return
        for line in quiet_lines if self.quiet else lines:
            _echo(line)

    def note(self, text: str) -> None:
        """Print a sentence beside the value, unless the command is quiet or writes JSON."""
        if not self.hides_progress:
            _echo(text)


def _echo(text: str) -> None:
    """Print a line on standard output.

    Raises:
        OutputError: standard output cannot be written, as where it is a file and the disk is full.
    """
    try:
        click.echo(text)
    except BrokenPipeError:  # whoever read the output has left
        raise
    except OSError as error:
        raise OutputError(f"Standard output cannot be written ({error.strerror or error}).") from None


def output_options(command: F) -> F:
    """Add ``--json`` and ``--quiet``; the command gets a :class:`Printer` as ``printer``."""

    @functools.wraps(command)
    def with_printer(*args: Any, as_json: bool, quiet: bool, **given: Any) -> Any:
        return command(*args, printer=Printer(as_json, quiet), **given)

    decorated: Any = click.option(
        "--quiet", "-q", is_flag=True, help="Show warnings and errors only; of lists, the ids or names."
    )(with_printer)
    return click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")(decorated)  # type: ignore[no-any-return]


def json_text(value: Any) -> str:
    r"""Return a value as JSON; numbers that are not finite become null, as JSON has none.

    Bytes of a file's name that are no text are written as escapes such as ``\udcff``, as Python has them.
    """
    try:
        return to_json(value, indent=2, inf_nan_mode="null", fallback=_plain_value).decode()
    except PydanticSerializationError:
        plain = to_jsonable_python(value, inf_nan_mode="null", fallback=_plain_value)
        return json.dumps(plain, indent=2)


def _plain_value(value: Any) -> Any:
    """Return arrays as lists and anything else that JSON does not know as text."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


def table_lines(headers: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """Return a table as lines, the headers first; no lines where there are no rows.

    Columns are as wide as what they hold, those of numbers lean right, and those without any are left out.
    """
    cells = [[str(cell) for cell in row] for row in rows]
    kept = [i for i in range(len(headers)) if any(row[i] for row in cells)]
    is_right = {i: all(_is_number(row[i]) for row in cells if row[i]) for i in kept}
    widths = {i: max(len(headers[i]), *(len(row[i]) for row in cells)) for i in kept}

    def line(texts: Sequence[str]) -> str:
        parts = (texts[i].rjust(widths[i]) if is_right[i] else texts[i].ljust(widths[i]) for i in kept)
        return "  ".join(parts).rstrip()

    return [line(headers), *map(line, cells)] if cells else []


def local_time(at: str | datetime | None) -> str:
    """Return a time, such as one of the service, as date and time of this machine's clock."""
    if not at:
        return ""
    moment = datetime.fromisoformat(at) if isinstance(at, str) else at
    return moment.astimezone().strftime("%Y-%m-%d %H:%M")


def _is_number(text: str) -> bool:
    return text.split(" ")[0].replace(",", "").replace(".", "").isdigit()
