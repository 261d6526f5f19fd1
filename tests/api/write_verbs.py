"""Writes src/octasplat/verbs.py: a Python function for each operation, made from the fields of its request.

Run it (``python tests/api/write_verbs.py``) after a change of a request; test_verbs.py compares.
"""

import inspect
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, BeforeValidator
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined
from verb_examples import EXAMPLES

from octasplat.engine.operations.base import Operation
from octasplat.engine.operations.registry import operations
from octasplat.engine.settings.fields import AlsoSequence, Positional, is_negatable

VERBS = Path(__file__).parents[2] / "src" / "octasplat" / "verbs.py"
PYTHON_NAMES = {"import": "import_", "stage-init": "stage_init"}
DECIDED_BY_OTHERS = {"mode", "format"}
"""Fields whose default is what fits the other fields."""
HEAD = '''"""The verbs of octasplat on files: a function for each, with the options of its command.

Written by tests/api/write_verbs.py from the requests of :mod:`octasplat.engine.operations`.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypedDict

from pydantic import BaseModel

from octasplat.array_types import Matrix, Numbers
from octasplat.engine.core.events import EventListener
from octasplat.engine.operations.base import never_stop
from octasplat.operation_calls import names_checked, run_operation
from octasplat.paths import PathLike
from octasplat.runs import OnStep, Run, reconstruct_run

if TYPE_CHECKING:
{imports}
'''
ON_STEP = "on_step: OnStep | None = None"
ON_STEP_ARGUMENT = (
    "on_step: called with the state of the training every few iterations; returning False stops it after a "
    "checkpoint, and the run that is returned is unfinished. With ``resume=True`` another call goes on."
)
LAST_PARAMETERS = (
    "progress: EventListener | None = None",
    "should_stop: Callable[[], bool] = never_stop",
    "threads: int = 0",
)
LAST_ARGUMENTS = (
    "progress: told each event; by default they are logged, or shown in a notebook.",
    "should_stop: asked now and then; True ends the work with ``CancelledError``.",
    "threads: number of threads; 0 takes all cores. The result does not depend on it.",
)


def type_text(annotation: Any, metadata: tuple[Any, ...] = ()) -> str:
    """Return the type of what a field takes, as source."""
    parts = [_one(annotation)]
    for mark in metadata:
        if isinstance(mark, BeforeValidator):
            more = mark.json_schema_input_type
            parts.append("str" if more is PydanticUndefined else type_text(more))
    alternatives = list(dict.fromkeys(alternative for part in parts for alternative in part.split(" | ")))
    if "Any" in alternatives:
        return "Any"
    alternatives.sort(key=lambda alternative: alternative == "None")
    return " | ".join(alternatives)


def _one(annotation: Any) -> str:
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return type_text(arguments[0], arguments[1:])
    if origin in (Union, UnionType):
        return " | ".join(type_text(argument) for argument in arguments)
    if origin is Literal:
        return f"Literal[{', '.join(map(_quoted, arguments))}]"
    if origin in (tuple, list, set, frozenset):
        inner = sorted({type_text(argument) for argument in arguments if argument is not Ellipsis})
        if inner == ["float"]:
            return "Numbers"
        if inner == ["Numbers"]:
            return "Matrix"
        # One value alone may stand where any number may be given.
        alone = " | PathLike" if Ellipsis in arguments and inner == ["PathLike"] else ""
        return f"Sequence[{' | '.join(inner)}]{alone}"
    if origin is dict or annotation is dict:
        return "Mapping[str, Any]"
    if isinstance(annotation, type):
        if issubclass(annotation, BaseModel):
            return "BaseModel | Mapping[str, Any]"
        known = {NoneType: "None", Path: "PathLike", str: "str", int: "int", float: "float", bool: "bool"}
        return known.get(annotation, "Any")
    return "Any"


def _quoted(value: object) -> str:
    return f'"{value}"' if isinstance(value, str) else repr(value)


def _default(name: str, info: FieldInfo) -> str:
    """Return the default as a sentence, nothing where the description says it or others decide it."""
    value, text = info.default, info.description or ""
    known = (
        isinstance(value, str | int | float | tuple) and not isinstance(value, bool) and value not in ("", ())
    )
    if not known or "default" in text or name in DECIDED_BY_OTHERS:
        return ""
    return f" Default: {value}."


def _parameters(fields: dict[str, FieldInfo]) -> Iterator[tuple[str, str, bool]]:
    """Yield name, declaration and whether it may be given by position."""
    for name, info in fields.items():
        text = type_text(info.annotation, tuple(info.metadata))
        places = name == "output" or any(isinstance(mark, Positional) for mark in info.metadata)
        if any(isinstance(mark, AlsoSequence) for mark in info.metadata):
            text = f"Sequence[{text}] | {text}"
        if info.is_required():
            yield name, f"{name}: {text}", places
            continue
        if isinstance(info.default, bool) and not is_negatable(info):
            yield name, f"{name}: {text} = {info.default}", places
            continue
        if "None" not in text.split(" | ") and text != "Any":
            text += " | None"
        yield name, f"{name}: {text} = None", places


def function(verb: "Operation[Any, Any]") -> str:
    """Return the source of a verb's function."""
    fields = verb.request.model_fields
    declared = list(_parameters(fields))
    first = [text for _, text, places in declared if places and "=" not in text]
    first += [text for _, text, places in declared if places and "=" in text]
    others = [text for _, text, places in declared if not places]
    others.sort(key=lambda text: "=" in text)  # what must be given comes first
    result, more, told = inspect.signature(verb.run).return_annotation.__name__, [], []
    if verb.name == "reconstruct":
        result, more, told = "Run", [ON_STEP], [ON_STEP_ARGUMENT]
    signature = ",\n    ".join([*first, "*", *others, *more, *LAST_PARAMETERS])
    order = [text.partition(":")[0] for text in (*first, *others)]
    arguments = [
        f"{name}: {' '.join((fields[name].description or '').split())}{_default(name, fields[name])}"
        for name in order
    ]
    wrapped = "\n".join(
        textwrap.fill(text, 104, initial_indent=" " * 8, subsequent_indent=" " * 12, break_long_words=False)
        for text in (*arguments, *told, *LAST_ARGUMENTS)
    )
    example = textwrap.indent(EXAMPLES[verb.name].strip(), " " * 4)
    values = "{" + ", ".join(f'"{name}": {name}' for name in fields) + "}"
    call = f'run_operation("{verb.name}", {values}, progress, should_stop, threads)'
    if verb.name == "reconstruct":
        call = f"reconstruct_run({values}, on_step, progress, should_stop, threads)"
    return (
        f'@names_checked\ndef {PYTHON_NAMES.get(verb.name, verb.name)}(\n    {signature},\n) -> "{result}":\n'
        f'    """{verb.title}\n\n    Args:\n{wrapped}\n\n    Raises:\n'
        "        OctasplatError: something cannot be read, done or written; the text says what.\n\n"
        f'{example}\n    """\n'
        f"    return {call}\n"
    )


def options(verb: "Operation[Any, Any]") -> str:
    """Return the source of a dictionary type that holds what is not given by position, for overloads."""
    declared = [text for _, text, places in _parameters(verb.request.model_fields) if not places]
    rows = "\n    ".join(text.partition(" = ")[0] for text in (*declared, *LAST_PARAMETERS))
    name = f"{verb.name.title()}Arguments"
    told = f'"""What :func:`{verb.name}` takes by name."""'
    return f"class {name}(TypedDict, total=False):\n    {told}\n\n    {rows}\n"


def source() -> str:
    """Return what the module should be, formatted."""
    verbs = operations()
    found = [inspect.signature(verb.run).return_annotation for verb in verbs if verb.name != "reconstruct"]
    results = sorted((result.__module__, result.__name__) for result in found)
    imports = "\n".join(f"    from {module} import {name}" for module, name in results)
    typed = [options(verb) for verb in verbs if verb.name == "render"]
    text = "\n\n".join([HEAD.format(imports=imports), *typed, *map(function, verbs)])
    for arguments in (
        ("check", "--fix", "--exit-zero", "--quiet"),
        ("format",),
    ):  # without imports that nothing needs
        command = (sys.executable, "-m", "ruff", *arguments, "--stdin-filename", str(VERBS), "-")
        text = subprocess.run(command, input=text, capture_output=True, text=True, check=True).stdout
    return text


if __name__ == "__main__":
    VERBS.write_text(source(), encoding="utf-8")
