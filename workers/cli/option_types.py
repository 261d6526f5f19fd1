"""Types of click options for the annotations of requests' fields."""

import types
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import annotated_types
import click
from pydantic.fields import FieldInfo


class ValueChoice(click.Choice[Any]):
    """One of several values, which need not be texts."""

    def __init__(self, values: Sequence[Any]) -> None:
        self._values = {str(value): value for value in values}
        self._former: frozenset[str] = frozenset()
        super().__init__(list(self._values))

    def also_take(self, former: Iterable[str]) -> None:
        """Take words of the last version, which the model reads, without offering them."""
        self._former = frozenset(former)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the value that a word stands for."""
        if value in self._former:
            return value
        return self._values[super().convert(str(value), param, ctx)]


def click_type(annotation: Any, info: FieldInfo | None) -> Any:
    """Return the click type of an annotation without None, bounded as the field says."""
    marks: list[Any] = list(info.metadata) if info is not None else []
    while get_origin(annotation) is Annotated:
        annotation, *more = get_args(annotation)
        marks += more
    if values := _literal_values(annotation):
        return ValueChoice(values)
    # of what Python takes in other ways, too, a command takes the file
    if annotation is Path or (_is_union(annotation) and any(map(_is_path, get_args(annotation)))):
        return click.Path(path_type=Path)
    if annotation in (int, float):
        return _number_range(annotation, marks)
    return annotation if annotation in (str, bool) else str


def _literal_values(annotation: Any) -> tuple[Any, ...]:
    """Return the values of a literal type, or of a union of such; none where it is something else."""
    if get_origin(annotation) is Literal:
        return get_args(annotation)
    if _is_union(annotation):
        parts = [_literal_values(part) for part in get_args(annotation) if part is not type(None)]
        return tuple(value for part in parts for value in part) if all(parts) else ()
    return ()


def _is_union(annotation: Any) -> bool:
    return get_origin(annotation) in (Union, types.UnionType)


def _is_path(annotation: Any) -> bool:
    return strip_optional(annotation)[0] is Path


def plain_click_type(annotation: Any) -> Any:
    """Return the click type of an annotation on its own."""
    return click_type(annotation, None)


def _number_range(kind: type, marks: Sequence[Any]) -> Any:
    low: Any = None
    high: Any = None
    low_open = high_open = False
    for mark in marks:
        # A Field within Annotated has its marks in itself.
        for part in getattr(mark, "metadata", None) or (mark,):
            if isinstance(part, annotated_types.Ge):
                low = part.ge
            elif isinstance(part, annotated_types.Gt):
                low, low_open = part.gt, True
            elif isinstance(part, annotated_types.Le):
                high = part.le
            elif isinstance(part, annotated_types.Lt):
                high, high_open = part.lt, True
    if low is None and high is None:
        return kind
    if kind is int:
        return click.IntRange(low, high, min_open=low_open, max_open=high_open)
    return click.FloatRange(low, high, min_open=low_open, max_open=high_open)


def strip_optional(annotation: Any) -> tuple[Any, bool]:
    """Return the annotation without None and marks, and whether None was in it."""
    if get_origin(annotation) is Annotated:
        return strip_optional(get_args(annotation)[0])
    if _is_union(annotation):
        parts = [part for part in get_args(annotation) if part is not type(None)]
        if len(parts) == 1:
            inner, _ = strip_optional(parts[0])
            return inner, True
    return annotation, False


def is_sequence(annotation: Any) -> bool:
    """Return whether an annotation is a tuple of any length."""
    return get_origin(annotation) is tuple and get_args(annotation)[-1] is Ellipsis
