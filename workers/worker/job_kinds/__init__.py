"""The kinds of jobs, in one table: what each needs, its options, and the program that does it.

A new kind is one call of :func:`octasplat.workers.worker.job_kinds.registry.register`; the API, the workers
and the command line take it from there.
"""

from octasplat.workers.worker.job_kinds import builtin as _builtin
from octasplat.workers.worker.job_kinds.registry import JobKind, get_job_kind, job_kinds, register

__all__ = ["JobKind", "get_job_kind", "job_kinds", "register"]

_builtin.register_builtin_kinds()
