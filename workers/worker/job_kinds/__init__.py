"""Kinds of jobs, in one table: the input, options and program of each.

The built-in ones are in :mod:`octasplat.workers.worker.job_kinds.builtin`. A further kind is one call of
:func:`octasplat.workers.worker.job_kinds.registry.register`; the API, the workers and the command line read
the table.
"""

from octasplat.workers.worker.job_kinds.registry import JobKind, get_job_kind, job_kinds, register

__all__ = ["JobKind", "get_job_kind", "job_kinds", "register"]
