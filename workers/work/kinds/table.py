"""The table of job kinds."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import BaseModel, ValidationError

from octasplat.engine.errors import ConfigError
from octasplat.workers.records.sizes import Sizes
from octasplat.workers.work.kinds.demands import Demand
from octasplat.workers.work.kinds.estimates import Estimate


@dataclass(frozen=True)
class JobKind:
    """A kind of job.

    Attributes:
        name: what the API calls it.
        title: one line for people.
        needs: what it works on: a committed dataset, or the results of a finished job.
        options: model of its options, whose JSON Schema is published.
        program: ``module:function`` that does the work, imported by the job's own process only; it takes a
            :class:`octasplat.workers.work.task.Task` and returns the names of its results.
        stages: names of its stages, in order, given the options.
        resolve: from what a user asks for to complete options.
        source_files: results of the source job that it reads, if it needs one; those that are missing are
            left out.
        needs_photographs: whether it reads the photographs of the source job as well.
        on_others: the options as they are kept where the job names photographs to work on in the place of the
            source job's; None for a kind that works on those only.
        needs_poses: whether its dataset must hold a COLMAP model, given the options.
        settle: the options as they are kept, given whether the dataset holds a COLMAP model.
        revise: complete options from those of a job and what a user changes of them.
        goes_on: whether the work that was done with the first options can be gone on with under the second.
        writes: names of the files that it writes in formats of their own, given the options.
        writes_at: where the options name those files.
        demands: what the options ask for that a service may set a ceiling to, given the photographs' sizes.
        names_files: files that the options name, each after the place where they do, with dots; they are
            uploaded as a dataset that holds files, and are in :attr:`octasplat.workers.work.task.Task.files`.
            None for a kind that takes no files.
        estimate: time and memory that it takes, given the options, the photographs' sizes and the number of
            cores; None where nobody knows.
    """

    name: str
    title: str
    needs: Literal["dataset", "result"]
    options: type[BaseModel]
    program: str
    stages: Callable[[BaseModel], tuple[str, ...]]
    resolve: Callable[[Mapping[str, Any]], BaseModel]
    source_files: tuple[str, ...] = ()
    needs_photographs: Callable[[BaseModel], bool] = lambda _options: False
    on_others: Callable[[BaseModel], BaseModel] | None = None
    needs_poses: Callable[[BaseModel], bool] = lambda _options: False
    settle: Callable[[BaseModel, bool], BaseModel] = lambda options, _has_poses: options
    revise: Callable[[Mapping[str, Any], Mapping[str, Any]], BaseModel] | None = None
    goes_on: Callable[[BaseModel, BaseModel], bool] = lambda before, after: before == after
    writes: Callable[[BaseModel], tuple[str, ...]] = lambda _options: ()
    writes_at: str = ""
    demands: Callable[[BaseModel, Sequence[Sizes]], Iterable[Demand]] = lambda _options, _sizes: ()
    names_files: Callable[[BaseModel], Iterable[tuple[str, str]]] | None = None
    estimate: Callable[[BaseModel, Sequence[Sizes], int], Estimate | None] = lambda _options, _sizes, _n: None

    def revised(self, before: Mapping[str, Any], changes: Mapping[str, Any]) -> BaseModel:
        """Complete options of a job that is tried again with changes; raises pydantic's ValidationError."""
        return self.resolve({**before, **changes}) if self.revise is None else self.revise(before, changes)


_KINDS: dict[str, JobKind] = {}


def register(kind: JobKind) -> JobKind:
    """Add a kind; its name must be new."""
    if kind.name in _KINDS:
        raise ValueError(f"a job kind named '{kind.name}' is registered already")
    _KINDS[kind.name] = kind
    return kind


def job_kinds() -> tuple[JobKind, ...]:
    """All kinds, in the order in which they were registered."""
    return tuple(_KINDS.values())


def kind_named(name: str) -> JobKind:
    """The kind of that name.

    Raises:
        ConfigError: there is none.
    """
    if name not in _KINDS:
        raise ConfigError(f"There is no job kind '{name}'; choose one of {', '.join(_KINDS)}.")
    return _KINDS[name]


def validated(model: type[BaseModel]) -> Callable[[Mapping[str, Any]], BaseModel]:
    """A ``resolve`` that only validates; it raises pydantic's :class:`ValidationError`."""

    def resolve(asked: Mapping[str, Any]) -> BaseModel:
        return model.model_validate(dict(asked))

    return resolve


__all__ = ["JobKind", "ValidationError", "job_kinds", "kind_named", "register", "validated"]
