"""Kinds of jobs, in one table: the input, options and program of each.

A new kind is one call of :func:`octasplat.workers.worker.job_kinds.registry.register`; the API, the workers
and the command line read the table.
"""

from octasplat.workers.worker.job_kinds import builtin as _builtin
from octasplat.workers.worker.job_kinds.registry import JobKind, get_job_kind, job_kinds, register

__all__ = ["JobKind", "get_job_kind", "job_kinds", "register"]

_builtin.register_builtin_kinds()
