"""Base classes of all operations' requests and results."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar, runtime_checkable

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from octasplat.engine.core.compiling import report_compilation
from octasplat.engine.core.errors import CancelledError, ConfigError
from octasplat.engine.core.events import Event, EventListener, Warned, ignore_events
from octasplat.engine.operations.precompile import compile_beside, request_groups
from octasplat.engine.settings import renamed_settings
from octasplat.engine.settings.fields import Output, Positional, Source
from octasplat.engine.settings.refusals import fault_message


class Options(BaseModel):
    """Base of the options of a verb: everything but where its input is read and its output written."""

    model_config = ConfigDict(frozen=True, extra="forbid", protected_namespaces=())

    former_names: ClassVar[renamed_settings.FormerNames] = renamed_settings.NONE

    @model_validator(mode="before")
    @classmethod
    def _by_new_names(cls, given: Any) -> Any:
        # jobs and scripts may have former names
        return renamed_settings.replace_former_names((cls,), given) if isinstance(given, Mapping) else given


class Request(Options):
    """Base of requests: the options of a verb, the input that it reads and the output that it writes."""


class WritingRequest(Request):
    """Base of requests that write files; see ``written_files`` for what may be replaced."""

    overwrite: bool = Field(
        False,
        description="Replace files that are there already, too, which are not of an earlier run of this "
        "command or were changed since. What is read is never replaced.",
    )


class SourceRequest(WritingRequest):
    """Base of requests that read a scene."""

    source: Source = Field(description="The scene to read: a file of any format, or the folder of a run.")


CHANGED_SCENE = (
    "The scene to write; the suffix says in which format. Of a run, a name without suffix writes a folder "
    "that is a run again, with what of it stays valid."
)


class SceneRequest(SourceRequest):
    """Base of requests that read a scene and write one."""

    output: Output = Field(description=CHANGED_SCENE)


class Result(BaseModel):
    """Base of results.

    Attributes:
        files: the files that were written.
        folder: of them; a job's results are named as they lie in it. None for the folder of the output.
    """

    model_config = ConfigDict(frozen=True, arbitrary_types_allowed=True)

    files: tuple[Path, ...] = ()
    folder: Path | None = None

    def lines(self) -> tuple[str, ...]:
        """Return what a command prints about the result, a sentence each."""
        return tuple(f"Wrote {path}." for path in self.files)

    def facts(self) -> Any:
        """Return the result as values of which JSON can be made: all fields but the folder of the files."""
        return {name: getattr(self, name) for name in type(self).model_fields if name != "folder"}

    def _repr_html_(self) -> str:
        """Return what a notebook shows."""
        return "<br>".join(escape(line) for line in self.lines())


class ScenesWritten(Result):
    """Base of results that are scenes.

    Attributes:
        notes: sentences about what was done, in order.
    """

    notes: tuple[str, ...] = ()

    def lines(self) -> tuple[str, ...]:
        """Return the notes, which end with the files."""
        return self.notes


RequestT = TypeVar("RequestT", bound=Request)
RequestT_contra = TypeVar("RequestT_contra", bound=Request, contravariant=True)
ResultT_co = TypeVar("ResultT_co", bound=Result, covariant=True)
OptionsT = TypeVar("OptionsT", bound=Options)
ModelT = TypeVar("ModelT", bound=BaseModel)


def never_stop() -> bool:
    """Return False: no stop is requested."""
    return False


@runtime_checkable
class Run(Protocol[RequestT_contra, ResultT_co]):
    """The function that executes a request."""

    def __call__(
        self,
        request: RequestT_contra,
        /,
        *,
        progress: EventListener = ignore_events,
        should_stop: Callable[[], bool] = never_stop,
        threads: int = 0,
    ) -> ResultT_co:
        """Execute ``request``.

        Args:
            request: what to do.
            progress: called with each event; warnings are events, too.
            should_stop: asked now and then; True ends the work with ``CancelledError``.
            threads: number of threads; 0 means all cores. It never changes the result.

        Raises:
            OctasplatError: something cannot be read, done or written.
        """


@dataclass(frozen=True)
class Operation(Generic[RequestT, ResultT_co]):
    """A verb with its request, options and function.

    Attributes:
        name: the verb, as the command and the job type are called.
        title: what it does, in one imperative sentence.
        request: class of its requests.
        options: class of its options, from which ``request`` inherits: what a job or a form is asked for.
        run: does a request.
    """

    name: str
    title: str
    request: type[RequestT]
    options: type[Options]
    run: Run[RequestT, ResultT_co]

    def execute(
        self,
        request: RequestT,
        *,
        progress: EventListener = ignore_events,
        should_stop: Callable[[], bool] = never_stop,
        threads: int = 0,
    ) -> ResultT_co:
        """Do a request as :meth:`Run.__call__`, its kernels compiled beside it, which ``progress`` is told.

        Raises:
            OctasplatError: as ``run`` does.
        """
        groups = request_groups(self.name, request)
        # kernels compile while the request still reads its input
        with report_compilation(progress), compile_beside(groups):
            return self.run(request, progress=progress, should_stop=should_stop, threads=threads)


def stop_if(should_stop: Callable[[], bool]) -> None:
    """Raise ``CancelledError`` if a stop is requested, before the next file is written.

    Raises:
        CancelledError: it is.
    """
    if should_stop():
        raise CancelledError("Stopped; files that were not written yet are not.")


def options_of(model: type[OptionsT], request: Options) -> OptionsT:
    """Return the options that a request has, whose class inherits from theirs."""
    # validated already, as the request was
    options = model.model_construct(**{name: getattr(request, name) for name in model.model_fields})
    assert isinstance(options, model)
    return options


class ContradictoryRequestError(ConfigError):
    """The request is incomplete or contradicts itself."""

    error_type = "contradictory_request"


def build_request(
    model: type[ModelT], values: Mapping[str, Any], place: Callable[[str], str] = lambda path: path
) -> ModelT:
    """Return the options or request with these values; None stands for the default.

    Args:
        model: class to make.
        values: values by field name.
        place: what users call the field at a path with dots, such as ``--max-side`` for ``max_side``.

    Raises:
        ContradictoryRequestError: the values do not go together, or something is missing; one sentence.
        ConfigError: a name is unknown, or a value is out of range; one sentence.
    """
    try:
        return model.model_validate({name: value for name, value in values.items() if value is not None})
    except ValidationError as error:
        of_all = not error.errors()[0]["loc"]  # a complaint without a place is about the whole request
        raise (ContradictoryRequestError if of_all else ConfigError)(first_error(error, place)) from None


def first_error(error: ValidationError, place: Callable[[str], str] = lambda path: path) -> str:
    """Return the first complaint of a validation as one sentence that names the field."""
    first = error.errors()[0]
    path = ".".join(str(part) for part in first["loc"])
    message = error_text(fault_message(first), place)
    return f"{place(path)}: {message}." if path else f"{message}."


def error_text(message: str, place: Callable[[str], str] = lambda path: path) -> str:
    """Return pydantic's message as it was raised by a validator, without a full stop.

    Args:
        message: the message; fields that a validator names stand in it between backquotes.
        place: what users call such a field.
    """
    sentence = message.removeprefix("Value error, ").removesuffix(".")
    return re.sub(r"`([\w.]+)`", lambda match: place(match[1]), sentence)


def emit_warning(progress: EventListener, message: str) -> None:
    """Emit a warning; the work continues."""
    progress(Warned(message))


__all__ = [
    "CHANGED_SCENE",
    "ContradictoryRequestError",
    "Event",
    "EventListener",
    "Operation",
    "Options",
    "Output",
    "Positional",
    "Request",
    "Result",
    "Run",
    "SceneRequest",
    "ScenesWritten",
    "SourceRequest",
    "WritingRequest",
    "build_request",
    "emit_warning",
    "error_text",
    "first_error",
    "ignore_events",
    "never_stop",
    "options_of",
    "stop_if",
]
