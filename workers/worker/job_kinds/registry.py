"""Base class of job kinds, and their registry."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Literal

from pydantic import BaseModel, ValidationError
from typing_extensions import TypeVar

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.dataset.image_sizes import ImageSizes
from octasplat.engine.settings.renamed_settings import replace_former_names
from octasplat.workers.worker.job_kinds.resource_limits import ResourceDemand

if TYPE_CHECKING:
    from octasplat.engine.operations.cost_model import Estimate
    from octasplat.engine.pathtracing.stage.model import StageMesh

OptionsT = TypeVar("OptionsT", bound=BaseModel, default=Any)


Needs = Literal["dataset", "result", "files"]


class JobKind(Generic[OptionsT]):
    """A kind of job; subclasses override methods.

    Args:
        name: what the API calls it.
        title: one line for people.
        needs: what it works on: a committed dataset of photographs, the results of a finished job, or only
            the files that its options name.
        options: model of its complete options, as they are kept.
        user_options: model of the options that users give, whose JSON Schema is published; by default
            ``options``.
        program: ``module:function`` that does the work, imported by the job's own process only; it takes a
            :class:`octasplat.workers.worker.task.Task`.
        stages: names of its stages, in order.
        source_files: results of the source job that it reads, if it needs one; those that are missing are
            left out, but for the first.
    """

    takes_files = False
    """Whether options may name files, which are uploaded as a dataset that holds files."""
    takes_other_photographs = False
    """Whether a job may name photographs to work on in the place of the source job's."""
    may_start_from_result = False
    """Whether a job on a dataset may begin with what another job of its kind has come to."""
    keeps_world_frame = True
    """Whether what is made stands where the photographs of the source job show it."""
    export_option = ""
    """Where the options name the files of :meth:`exported_files`."""
    is_internal = False
    """Whether only other jobs queue it, so that nobody can ask for it."""
    block_kind = ""
    """The kind of the jobs that train its blocks, if its program may plan some; see ``BlocksPlanned``."""

    def __init__(
        self,
        *,
        name: str,
        title: str,
        needs: Needs,
        options: type[OptionsT],
        program: str,
        stages: Sequence[str] = (),
        source_files: Sequence[str] = (),
        user_options: type[BaseModel] | None = None,
    ) -> None:
        self.name, self.title, self.needs, self.options, self.program = name, title, needs, options, program
        self.user_options: type[BaseModel] = user_options or options
        self.source_files = tuple(source_files)
        self._stages = tuple(stages)

    def resolve(self, values: Mapping[str, Any]) -> OptionsT:
        """Return complete options from what a user asks for.

        Raises:
            ValidationError: an option cannot be used.
            InvalidSettingsError: likewise, with a sentence for each.
        """
        return self.options.model_validate(dict(values))

    def revise(self, options: Mapping[str, Any], changes: Mapping[str, Any]) -> OptionsT:
        """Return complete options with changes; raises as :meth:`resolve` does."""
        return self.resolve({**options, **changes})

    def as_requested(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return what a user asks for as it is kept: under the present names, and nothing but that."""
        return replace_former_names((self.user_options,), values)

    def revise_requested(self, requested: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
        """Return what a user asks for with changes; both are as :meth:`as_requested` keeps them."""
        return {**requested, **changes}

    def stages(self, options: OptionsT) -> tuple[str, ...]:
        """Return the names of its stages, in order."""
        return self._stages

    def needs_photographs(self, options: OptionsT) -> bool:
        """Return whether it reads the photographs of the source job as well."""
        return False

    def needed_files(self, options: OptionsT, run: Path, names: Sequence[str]) -> Collection[str] | None:
        """Return the files of its dataset without which the work cannot be done; None for all.

        Args:
            options: of the job.
            run: the engine's output folder, with what earlier attempts and other jobs have left there.
            names: paths of all files of the dataset.

        Raises:
            CheckpointError: what tells so is damaged.
        """
        return None

    def for_other_photographs(self, options: OptionsT) -> OptionsT:
        """Return the options as they are kept where the job names photographs of its own."""
        return options

    def starts_from_result(self, options: OptionsT) -> bool:
        """Return whether the job begins with what its source job has come to, and so cannot begin without."""
        return False

    def with_start(self, options: OptionsT) -> OptionsT:
        """Return the options as they are kept where the job begins with what its source job has come to.

        Raises:
            InvalidSettingsError: with these options it cannot.
        """
        return options

    def needs_poses(self, options: OptionsT) -> bool:
        """Return whether its dataset must hold a COLMAP model."""
        return False

    def with_poses_known(self, options: OptionsT, has_poses: bool) -> OptionsT:
        """Return the options as they are kept, given whether the dataset holds a COLMAP model."""
        return options

    def is_resumable_with(self, old: OptionsT, new: OptionsT) -> bool:
        """Return whether the work that was done with the first options can go on under the second."""
        return old == new

    def exported_files(self, options: OptionsT) -> tuple[str, ...]:
        """Return the names of the files that it writes in formats of their own."""
        return ()

    def resource_demands(self, options: OptionsT, sizes: Sequence[ImageSizes]) -> Iterable[ResourceDemand]:
        """Return the demands of the options that a service may limit, for such photographs."""
        return ()

    def removes_stored_frames(self, options: OptionsT) -> bool:
        """Return whether finished frames leave the folder once they are stored; see ``stored_frames``."""
        return False

    def named_files(self, options: OptionsT) -> Iterable[tuple[str, str]]:
        """Return the files that the options name, each after the place where they do, with dots."""
        return ()

    def glass_meshes(self, options: OptionsT) -> "Mapping[int, StageMesh]":
        """Return the meshes of files that must be closed, by their numbers in ``stage.meshes``."""
        return {}

    def options_of_block(self, options: OptionsT, number: int, iterations: int, plan: str) -> dict[str, Any]:
        """Return the options of the job of a block, as JSON values.

        Args:
            options: of the whole job.
            number: of the block, from 1.
            iterations: of its training.
            plan: digests of what the block begins with.
        """
        raise NotImplementedError

    def estimate(self, options: OptionsT, sizes: Sequence[ImageSizes], cores: int) -> "Estimate | None":
        """Return the time and memory on so many cores; None where it is unknown."""
        return None


_BUILTIN_MODULE = "octasplat.workers.worker.job_kinds.builtin"
"""Holds ``BUILTIN_KINDS``; not imported here, as the process of a job of another kind goes without."""

_KINDS: dict[str, JobKind[Any]] = {}
"""Those that are not built in."""


@cache
def _builtin_kinds() -> Mapping[str, JobKind[Any]]:
    """Return the built-in kinds by name."""
    return {kind.name: kind for kind in import_module(_BUILTIN_MODULE).BUILTIN_KINDS}


def register(kind: JobKind[Any]) -> JobKind[Any]:
    """Add a kind; its name must be new, which :func:`job_kinds` compares with those of the built-in ones."""
    if kind.name in _KINDS:
        raise ValueError(f"a job kind named '{kind.name}' is registered already")
    _KINDS[kind.name] = kind
    return kind


def job_kinds(*, with_internal: bool = False) -> tuple[JobKind[Any], ...]:
    """Return all kinds: the built-in ones, then others in the order in which they were registered.

    Args:
        with_internal: those, too, that nobody can ask for.
    """
    builtin = _builtin_kinds()
    for name in builtin.keys() & _KINDS.keys():
        raise ValueError(f"a job kind named '{name}' is built in already")
    kinds = (*builtin.values(), *_KINDS.values())
    return tuple(kind for kind in kinds if with_internal or not kind.is_internal)


def get_job_kind(name: str, *, is_asked_for: bool = False) -> JobKind[Any]:
    """Return the kind of that name.

    Args:
        name: of the kind.
        is_asked_for: whether somebody asks for it, who may have no internal one.

    Raises:
        ConfigError: there is none.
    """
    kind = _KINDS.get(name) or _builtin_kinds().get(name)
    if kind is None or (is_asked_for and kind.is_internal):
        names = ", ".join(known.name for known in job_kinds())
        raise ConfigError(f"There is no job kind '{name}'; choose one of {names}.")
    return kind


__all__ = ["JobKind", "ValidationError", "get_job_kind", "job_kinds", "register"]
