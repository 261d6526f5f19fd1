"""Marks on the fields of requests beside their type: unit, role, and command-line spelling."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import BaseModel, FiniteFloat, GetJsonSchemaHandler
from pydantic.fields import FieldInfo
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

SettingLevel = Literal["basic", "advanced", "experimental"]


class _InSchema:
    """Base of marks that appear in the JSON schema of a field."""

    def schema_entries(self) -> Mapping[str, object]:
        raise NotImplementedError

    def __get_pydantic_json_schema__(
        self, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        return {**handler(core_schema), **self.schema_entries()}


@dataclass(frozen=True)
class Unit(_InSchema):
    """The unit of a number, such as ``px`` or ``degrees``."""

    symbol: str

    def schema_entries(self) -> Mapping[str, object]:
        """Return the entries of the JSON schema."""
        return {"unit": self.symbol}


@dataclass(frozen=True)
class Group(_InSchema):
    """Audience of a setting; forms and documents list the basic ones first."""

    level: SettingLevel

    def schema_entries(self) -> Mapping[str, object]:
        """Return the entries of the JSON schema."""
        return {"group": self.level}


BASIC, ADVANCED, EXPERIMENTAL = Group("basic"), Group("advanced"), Group("experimental")


@dataclass(frozen=True)
class PartialOf:
    """Mark of a nested mapping that has some of the fields of a model; its schema is the model's.

    Attributes:
        model: ``module:class``, imported when the schema is asked for.
    """

    model: str

    def __get_pydantic_json_schema__(
        self, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        # imported late: the module of options imports nothing heavy
        module, _, name = self.model.partition(":")
        model: type[BaseModel] = getattr(import_module(module), name)
        return handler(model.__pydantic_core_schema__)


@dataclass(frozen=True)
class Shortcut(_InSchema):
    """Mark of a field that stands for a setting of the training, by its name; forms show that one."""

    setting: str

    def schema_entries(self) -> Mapping[str, object]:
        """Return what stands in the schema."""
        return {"shortcut": self.setting}


@dataclass(frozen=True)
class Spelling:
    """Command-line spelling of a field, where it is not ``--name-of-field``.

    Attributes:
        flags: flags of the option, such as ``("-o", "--output")``.
        metavar: what stands for the value in the help.
        hidden: whether the command does not have it.
        repeated: whether the option may be given several times, each time with a text that the field reads.
        negatable: whether a switch that is off by default can be said to be off, as where another option
            switches it on.
    """

    flags: tuple[str, ...] = ()
    metavar: str | None = None
    hidden: bool = False
    repeated: bool = False
    negatable: bool = False


def is_negatable(info: FieldInfo) -> bool:
    """Return whether the field is a switch that is on, off or not given; see :class:`Spelling`."""
    return any(isinstance(mark, Spelling) and mark.negatable for mark in info.metadata)


@dataclass(frozen=True)
class Positional:
    """Mark of a field that a command takes as an argument rather than an option."""

    metavar: str


@dataclass(frozen=True)
class ReadPath:
    """Mark of a path, a file or a folder, that is read where it is and so has to exist."""


@dataclass(frozen=True)
class AlsoSequence:
    """Mark of a path in whose place Python may be given a list, which the request sorts out by itself."""


@dataclass(frozen=True)
class NamedFile(_InSchema):
    """Mark of a file that options name; a job finds it by name among the files that came with it."""

    def schema_entries(self) -> Mapping[str, object]:
        """Return the entries of the JSON schema."""
        return {"format": "octasplat-file"}


BoxCorners = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
"""Two corners of a box along the axes, smallest coordinates first."""
InputFile = Annotated[Path, NamedFile()]
"""A file that options name: a path here, a name among the job's files in a service."""
Source = Annotated[Path, Positional("IN"), ReadPath()]
"""The input that a verb works on; a job has its own."""
OUTPUT_FLAGS = Spelling(("-o", "--output"))
Output = Annotated[Path, OUTPUT_FLAGS]
"""Where a verb writes; a job has its own place."""
DatasetFolder = Annotated[Path | None, Spelling(("--dataset",), metavar="FOLDER"), ReadPath()]
"""The folder of a run's photographs; a job that needs them has its own."""


def iter_named_files(options: BaseModel) -> Iterator[tuple[str, Path]]:
    """Yield each file that the options name, after the place where they do, with dots."""
    for name, info in type(options).model_fields.items():
        yield from _files_in(_full_annotation(info), getattr(options, name), name)


def iter_read_paths(model: type[BaseModel], values: Mapping[str, Any]) -> Iterator[Path]:
    """Yield each path that a request of this class would read: fields marked ReadPath, and named files.

    Args:
        model: class of the request.
        values: paths and other values by field name, of those fields that were given.
    """
    fields = {name: info for name, info in model.model_fields.items() if name in values}
    for name, info in fields.items():
        if isinstance(values[name], Path) and any(isinstance(mark, ReadPath) for mark in info.metadata):
            yield values[name]
    for name, info in fields.items():
        for _, path in _files_in(_full_annotation(info), values[name], name):
            yield path


def accepts_files(model: type[BaseModel]) -> bool:
    """Return whether options of this class can name files."""
    return any(_has_files(_full_annotation(info)) for info in model.model_fields.values())


def map_named_files(options: BaseModel, change: Callable[[Path], Path]) -> dict[str, Any]:
    """Return the values of the options by field name, each file that they name replaced by ``change``."""
    values: dict[str, Any] = {}
    for name, info in type(options).model_fields.items():
        values[name] = _map_files(_full_annotation(info), getattr(options, name), change)
    return values


def _full_annotation(info: FieldInfo) -> Any:
    """Return the annotation of a field with its marks."""
    return Annotated[info.annotation, *info.metadata] if info.metadata else info.annotation


def _is_file(annotation: Any) -> bool:
    return get_origin(annotation) is Annotated and any(
        isinstance(mark, NamedFile) for mark in get_args(annotation)[1:]
    )


def _has_files(annotation: Any) -> bool:
    return _is_file(annotation) or any(_has_files(inner) for inner in get_args(annotation))


def _files_in(annotation: Any, value: Any, place: str) -> Iterator[tuple[str, Path]]:
    if value is None or not _has_files(annotation):
        return
    if isinstance(value, tuple | list):
        for number, item in enumerate(value):
            yield from _files_in(annotation, item, f"{place}.{number}")
    elif isinstance(value, Path):
        yield place, value


def _map_files(annotation: Any, value: Any, change: Callable[[Path], Path]) -> Any:
    if value is None or not _has_files(annotation):
        return value
    if isinstance(value, tuple | list):
        return tuple(_map_files(annotation, item, change) for item in value)
    return change(value) if isinstance(value, Path) else value
