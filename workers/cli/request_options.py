"""Options of commands, made from the fields of requests."""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar, get_args, get_origin

import click
from pydantic import BaseModel, BeforeValidator
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from octasplat.engine.core.errors import CancelledError
from octasplat.engine.core.events import Event, EventListener, Noted, PhaseStarted
from octasplat.engine.operations.base import (
    ContradictoryRequestError,
    Operation,
    Result,
    build_request,
    never_stop,
)
from octasplat.engine.operations.written_files import remember_written
from octasplat.engine.settings.fields import Positional, Spelling, is_negatable
from octasplat.engine.settings.renamed_settings import former_names, notify_renamed
from octasplat.workers.cli.collector import rare_collections
from octasplat.workers.cli.input_paths import check_inputs
from octasplat.workers.cli.option_types import (
    ValueChoice,
    click_type,
    is_sequence,
    plain_click_type,
    strip_optional,
)
from octasplat.workers.cli.options import threads_option
from octasplat.workers.cli.printing import Printer, output_options
from octasplat.workers.cli.progress import show_progress
from octasplat.workers.cli.signals import StoppedError, exit_on_sigterm, request_stop_on_signals

Command = Callable[..., Any]
ResultT = TypeVar("ResultT", bound=Result)


def request_options(model: type[BaseModel], *, exclude: Sequence[str] = ()) -> Callable[[Command], Command]:
    """Return a decorator that gives a command the options of a request.

    The command is called with one keyword argument for each field; what the user did not give is None. What
    has to be given comes first.

    Args:
        model: class of the request.
        exclude: fields that the command spells in another way.
    """
    listed = sorted(model.model_fields.items(), key=lambda field: not field[1].is_required())
    fields = {name: info for name, info in listed if name not in exclude}
    values = former_names(model).values
    decorators = [
        _option_decorator(name, info, former_values=values.get(name))
        for name, info in fields.items()
        if not _spelling_of(info).hidden
    ]
    decorators += [_former_option(flag, fields[name]) for flag, name in _former_flags(model, fields).items()]

    def decorate(command: Command) -> Command:
        # What is decorated last comes first in the help.
        for decorator in reversed(decorators):
            command = decorator(command)
        return command

    return decorate


def operation_command(
    operation: Operation[Any, Any],
    *,
    is_stoppable: bool = False,
    threads: bool = False,
    cls: type[click.Command] = click.Command,
) -> click.Command:
    """Return the command of an operation that needs nothing but its request.

    Args:
        operation: the verb.
        is_stoppable: whether the operation asks ``should_stop``; else a signal ends it where it is.
        threads: whether the command has ``--threads``.
        cls: class of the command.
    """

    def run(printer: Printer, threads: int = 0, **given: Any) -> None:
        request = request_from_options(operation.request, given)
        run_operation(operation, request, printer, threads=threads, is_stoppable=is_stoppable)

    command: Command = output_options(run)
    if threads:
        command = threads_option(command)
    command = request_options(operation.request)(command)
    help_text = (operation.request.__doc__ or "").replace("``", "")
    make = click.command(operation.name, cls=cls, short_help=operation.title, help=help_text)
    made: click.Command = make(command)
    return made


def request_from_options(model: type[Any], given_values: dict[str, Any]) -> Any:
    """Return the request with what the user gave; what was not given keeps its default.

    Raises:
        UsageError: what is asked for is not complete, or contradicts itself.
        ConfigError: a value is out of range; the sentence names the option.
        SceneFileError: what is to be read does not exist, which is found before anything heavy is imported.
    """
    values = {
        name: value
        for name, value in _by_new_flags(model, given_values).items()
        # An option that may be repeated is () where it was not given.
        if value is not None and not (value == () and _may_repeat(model.model_fields[name]))
    }
    for name, info in model.model_fields.items():
        # click takes an option whose default is None for given, from 8.3 on
        if info.is_required() and name not in values:
            raise click.UsageError(f"Missing option '{option_name(model, name)}'.")
    check_inputs(model, values)  # some requests look into their source, with much to import
    try:
        return build_request(model, values, functools.partial(option_name, model))
    except ContradictoryRequestError as error:
        raise click.UsageError(str(error)) from None


def run_operation(
    operation: Operation[Any, ResultT],
    request: Any,
    printer: Printer,
    *,
    threads: int = 0,
    is_stoppable: bool = False,
    first_sentence: Callable[[], str | None] = lambda: None,
) -> ResultT:
    """Do a request with its progress shown, print what came of it, and return it.

    Args:
        operation: the verb.
        request: of it.
        printer: how results are printed.
        threads: number of threads; 0 means all cores.
        is_stoppable: as for :func:`operation_command`.
        first_sentence: returns a sentence to show as the first stage begins, when nothing was refused.

    Raises:
        OctasplatError: as the operation does.
        StoppedError: a signal asked to stop.
    """
    if is_stoppable:
        with request_stop_on_signals() as should_stop, rare_collections() as end_start:
            try:
                with show_progress(quiet=printer.hides_progress, should_stop=should_stop) as progress:
                    listener = (
                        progress if printer.hides_progress else _with_first_sentence(progress, first_sentence)
                    )
                    listener = _at_first_event(end_start, listener)
                    result = operation.execute(
                        request, progress=listener, should_stop=should_stop, threads=threads
                    )
            except CancelledError as error:
                raise StoppedError(str(error), should_stop.exit_code) from None
    else:
        with (
            exit_on_sigterm(),
            rare_collections() as end_start,
            show_progress(quiet=printer.hides_progress) as progress,
        ):
            listener = _at_first_event(end_start, progress)
            result = operation.execute(request, progress=listener, should_stop=never_stop, threads=threads)
    remember_written(operation.name, result.files)
    printer.print(result, result.lines())
    return result


def _at_first_event(act: Callable[[], None], progress: EventListener) -> EventListener:
    """Return a listener that acts before the first event: what the work needs is imported by then."""
    has_begun = False

    def listen(event: Event) -> None:
        nonlocal has_begun
        if not has_begun:
            has_begun = True
            act()
        progress(event)

    return listen


def _with_first_sentence(progress: EventListener, first_sentence: Callable[[], str | None]) -> EventListener:
    """Return a listener that notes a sentence before the first stage on photographs."""
    is_open = False

    def listen(event: Event) -> None:
        nonlocal is_open
        # The frames of a video are chosen first; before that there are no photographs to estimate by.
        if isinstance(event, PhaseStarted) and event.stage != "frames" and not is_open:
            is_open = True
            if (sentence := first_sentence()) is not None:
                progress(Noted(sentence))
        progress(event)

    return listen


def option_name(model: type[BaseModel], path: str) -> str:
    """Return what users of the command call the field at a path with dots."""
    name, _, rest = path.partition(".")
    info = model.model_fields.get(name)
    if info is None:
        return path
    if (place := _find_mark(info, Positional)) is not None:
        return place.metavar
    part = rest.partition(".")[0]
    flag = _option_flags(name, info)[-1].partition("/")[0]
    return f"{flag} {part}" if part and not part.isdigit() else flag


def _former_flags(model: type[BaseModel], fields: Mapping[str, FieldInfo]) -> dict[str, str]:
    """Return the field of each flag that the last version had, of those fields that have an option."""
    names = former_names(model)
    spelt = {f"--{old.replace('_', '-')}": new for old, new in names.fields.items()} | dict(names.flags)
    taken = {flag for name, info in fields.items() for flag in _option_flags(name, info)}
    return {
        flag: name
        for flag, name in spelt.items()
        if flag not in taken
        and name in fields
        and not _spelling_of(fields[name]).hidden
        and _find_mark(fields[name], Positional) is None
    }


def _former_option(flag: str, info: FieldInfo) -> Callable[[Command], Command]:
    """Return the decorator of a hidden option: the field's by its former flag."""
    return _option_decorator(_former_parameter(flag), info, (flag,), hidden=True)


def _former_parameter(flag: str) -> str:
    """Return the name under which a command gets what a former flag was given."""
    return f"former{flag.replace('-', '_')}"


def _by_new_flags(model: type[BaseModel], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the user gave by field, also what was given by former flags, which is told.

    Raises:
        UsageError: one field is given by both flags.
    """
    values = dict(given)
    for flag, name in _former_flags(model, model.model_fields).items():
        value = values.pop(_former_parameter(flag), None)
        if value is None or value == ():
            continue
        present = option_name(model, name)
        if values.get(name) not in (None, ()):
            raise click.UsageError(f"{flag} is the former name of {present}; give one of the two.")
        notify_renamed({flag: present})
        values[name] = value
    return values


def _option_decorator(
    name: str,
    info: FieldInfo,
    former: tuple[str, ...] = (),
    *,
    hidden: bool = False,
    former_values: Mapping[str, str] | None = None,
) -> Callable[[Command], Command]:
    """Return the decorator of a field's argument or option.

    Args:
        name: of the parameter.
        info: the field.
        former: flags to take instead of the field's own.
        hidden: whether the help leaves the option out, which need not be given then.
        former_values: values that the last version had, which are taken, too.
    """
    inner, optional = strip_optional(info.annotation)
    if (place := _find_mark(info, Positional)) is not None:
        many = is_sequence(inner)
        return (
            click.argument(
                name,
                metavar=f"{place.metavar}...",
                nargs=-1,
                required=info.is_required(),
                type=click_type(get_args(inner)[0], None),
            )
            if many
            else click.argument(
                name, metavar=place.metavar, required=info.is_required(), type=click_type(inner, info)
            )
        )
    spelling = _spelling_of(info)
    settings: dict[str, Any] = {
        "help": _help_text(info, optional),
        "required": info.is_required() and not hidden,
        "metavar": spelling.metavar or _default_metavar(inner),
        "default": None,
        "hidden": hidden,
    }
    flags = former or _option_flags(name, info)
    if _is_parsed_from_text(info):
        if spelling.repeated:
            return click.option(*flags, name, multiple=True, **settings)
        return click.option(*flags, name, type=str, **settings)
    if inner is bool:
        return click.option(*flags, name, is_flag=True, help=settings["help"], default=None, hidden=hidden)
    if is_sequence(inner):
        item = get_args(inner)[0]
        settings["multiple"] = True
        if get_origin(item) is tuple:
            return click.option(*flags, name, type=tuple(map(plain_click_type, get_args(item))), **settings)
        return click.option(*flags, name, type=click_type(item, None), **settings)
    if get_origin(inner) is tuple:
        parts = get_args(inner)
        if len(set(parts)) == 1:
            return click.option(*flags, name, nargs=len(parts), type=click_type(parts[0], None), **settings)
        return click.option(*flags, name, type=tuple(map(plain_click_type, parts)), **settings)
    kind = click_type(inner, info)
    if former_values and isinstance(kind, ValueChoice):
        kind.also_take(former_values)
    return click.option(*flags, name, type=kind, **settings)


def _is_parsed_from_text(info: FieldInfo) -> bool:
    return any(isinstance(mark, BeforeValidator) for mark in info.metadata)


def _may_repeat(info: FieldInfo) -> bool:
    """Return whether the option may be given several times, so that none at all is an empty tuple."""
    return _spelling_of(info).repeated or (
        not _is_parsed_from_text(info) and is_sequence(strip_optional(info.annotation)[0])
    )


def _option_flags(name: str, info: FieldInfo) -> tuple[str, ...]:
    if flags := _spelling_of(info).flags:
        return flags
    flag = "--" + name.replace("_", "-")
    inner, _ = strip_optional(info.annotation)
    has_opposite = inner is bool and (info.default is True or is_negatable(info))
    return (f"{flag}/--no-{name.replace('_', '-')}" if has_opposite else flag,)


def _help_text(info: FieldInfo, optional: bool) -> str:
    text = info.description or ""
    default = info.default
    shows_default = default not in (None, PydanticUndefined, ()) and not isinstance(default, bool | BaseModel)
    if shows_default:
        value = " ".join(map(str, default)) if isinstance(default, tuple) else default
        return f"{text}  [default: {value}]"
    return text


def _default_metavar(annotation: Any) -> str | None:
    parts = get_args(annotation) if get_origin(annotation) is tuple else ()
    if parts and parts[-1] is not Ellipsis and len(set(parts)) == 1 and len(parts) == 3:
        return "X Y Z"
    return None


def _spelling_of(info: FieldInfo) -> Spelling:
    return _find_mark(info, Spelling) or Spelling()


def _find_mark(info: FieldInfo, kind: type[Any]) -> Any:
    return next((mark for mark in info.metadata if isinstance(mark, kind)), None)
