"""Refusals of settings: one short sentence for each, the same for every interface."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.settings.nearest_names import nearest_name

_LONGEST_VALUE = 60
"""Characters of a refused value that a sentence shows; what is longer is in the user's own words anyway."""


@dataclass(frozen=True)
class Refusal:
    """A setting that cannot be used.

    Attributes:
        path: where it is in the model.
        code: what ails it, for programs, as pydantic names it.
        sentence: names it and says what it must be.
    """

    path: tuple[str | int, ...]
    code: str
    sentence: str


class InvalidSettingsError(ConfigError):
    """Settings that are unknown, out of range or contradictory; the message is the first one's sentence."""

    error_type = "settings_refused"

    def __init__(self, refusals: Sequence[Refusal]) -> None:
        super().__init__(refusals[0].sentence)
        self.refusals = tuple(refusals)


def refusals_from(error: ValidationError, model: type[BaseModel]) -> list[Refusal]:
    """Return what a validation by ``model`` refused, each setting once, in order."""
    found: dict[tuple[str | int, ...], Refusal] = {}
    for fault in error.errors(include_url=False):
        if fault["type"] == "extra_forbidden":
            refusal = _unknown_field_refusal(model, fault["loc"])
        else:
            path, _, _ = path_in_model(model, fault["loc"])
            refusal = Refusal(path, fault["type"], _fault_sentence(path, fault))
        found.setdefault(refusal.path, refusal)  # pydantic may have several complaints about one setting
    return list(found.values())


def fault_message(fault: Mapping[str, Any]) -> str:
    """Return what ails a value, without its name and a full stop, in words that pydantic may lack.

    Args:
        fault: one of the errors of a ``ValidationError``.
    """
    given = type(fault.get("input")).__name__
    if fault["type"] in ("path_type", "is_instance_of") and "Path" in str(fault["msg"]):
        hint = "; write the scene to a file first (octasplat.save)" if given == "Scene" else ""
        return f"must be the path of a file or folder, not {_with_article(given)}{hint}"
    if fault["type"] in ("tuple_type", "list_type"):
        return f"must be a list, not {_with_article(given)}"
    if fault["type"] in ("too_short", "too_long"):
        name, bound = (
            ("min_length", "at least") if fault["type"] == "too_short" else ("max_length", "at most")
        )
        limit, count = fault["ctx"][name], fault["ctx"]["actual_length"]
        return f"must have {bound} {limit} {'value' if limit == 1 else 'values'}, not {count}"
    if fault["type"] == "missing" and isinstance(fault["loc"][-1], int):
        return f"is missing; the {len(fault['input'])} values that are given are too few"
    return str(fault["msg"]).removeprefix("Value error, ").removesuffix(".")


def _with_article(name: str) -> str:
    return f"{'an' if name[:1].lower() in 'aeiou' else 'a'} {name}"


def refuse_unknown_setting(
    path: Sequence[str | int],
    known: Iterable[str],
    of_kind: str = "",
    former: Mapping[str, str] = MappingProxyType({}),
) -> Refusal:
    """Return the refusal of an unknown setting, which offers the nearest known one.

    Args:
        path: where it is.
        known: names of settings.
        of_kind: the kind of section that it is in, where there are several.
        former: names of settings by those of the last version; near one of these, its new name is offered.
    """
    name = setting_name(path)
    nearest = nearest_name(name, [*known, *former])
    nearest = former.get(nearest, nearest) if nearest else None
    help_text = f"; the nearest is {nearest}." if nearest else "; octasplat config list --all lists them."
    if of_kind:
        help_text = f" where the kind is {of_kind}{help_text}"
    return Refusal(tuple(path), "unknown_setting", f"There is no setting '{name}'{help_text}")


def setting_name(path: Sequence[str | int]) -> str:
    """Return the name by which users set what is at ``path``; those of the training need no ``train.``.

    >>> setting_name(("train", "lr", "quat")), setting_name(("test_every",))
    ('lr.quat', 'test_every')
    """
    return ".".join(map(str, path[1:] if path[0] == "train" and len(path) > 1 else path))


def submodels(annotation: Any) -> tuple[type[BaseModel], ...]:
    """Return the models among the alternatives of an annotation."""
    if get_origin(annotation) is Annotated:
        return submodels(get_args(annotation)[0])
    if get_origin(annotation) is Union or hasattr(annotation, "__args__"):
        return tuple(model for part in get_args(annotation) for model in submodels(part))
    return (annotation,) if isinstance(annotation, type) and issubclass(annotation, BaseModel) else ()


def _fault_sentence(path: Sequence[str | int], fault: Mapping[str, Any]) -> str:
    is_ours = fault["type"] == "value_error"
    # such a sentence names the settings itself
    name = "" if is_ours and tuple(path) == ("train",) else setting_name(path)
    message = fault_message(fault)
    value = fault.get("input")
    shows_value = not is_ours and (isinstance(value, str | int | float | bool) or value is None)
    value_text = f" (it is {value!r})" if shows_value and len(repr(value)) <= _LONGEST_VALUE else ""
    return f"{name}: {message}{value_text}." if name else f"{message}."


def _unknown_field_refusal(model: type[BaseModel], place: Sequence[str | int]) -> Refusal:
    """Return the refusal of a field that a model does not have."""
    path, models, kind = path_in_model(model, place[:-1])
    if kind:
        models = tuple(inner for inner in models if inner.model_fields["kind"].default == kind)
    prefix = f"{setting_name(path)}." if path else ""
    known = [f"{prefix}{name}" for inner in models for name in inner.model_fields]
    return refuse_unknown_setting((*path, place[-1]), known, kind)


def _kind_of(model: type[BaseModel]) -> object:
    return model.model_fields["kind"].default if "kind" in model.model_fields else None


def path_in_model(
    model: type[BaseModel], place: Sequence[str | int]
) -> tuple[tuple[str | int, ...], tuple[type[BaseModel], ...], str]:
    """Return the path of a setting without the parts that pydantic adds for union types.

    Returns:
        The path, the models of what is there, and the kind where there are several.
    """
    path: list[str | int] = []
    models: tuple[type[BaseModel], ...] = (model,)
    kind = ""
    for part in place:
        tagged = [] if kind or len(models) < 2 else [inner for inner in models if _kind_of(inner) == part]
        if tagged:  # pydantic names the kind first, which may also be the name of a field
            models, kind = tuple(tagged), str(part)
            continue
        infos = [inner.model_fields[part] for inner in models if part in inner.model_fields]
        if infos:
            models, kind = submodels(infos[0].annotation), ""
        elif len(models) > 1:
            kind = str(part)
        if infos or isinstance(part, int):
            path.append(part)
    return tuple(path), models, kind
