"""The toy of a later version, in which another number of steps is the default."""

from octasplat.workers.worker.job_kinds import JobKind, register
from octasplat.workers.worker.job_kinds.registry import _KINDS
from tests.support.toy_kind import ToyOptions


class OtherDefaults(ToyOptions):
    steps: int = 4


_KINDS.pop("toy")
register(
    JobKind(
        name="toy",
        title="Counts",
        needs="dataset",
        options=OtherDefaults,
        program="tests.support.toy_kind:run",
        stages=("train",),
    )
)
