"""The kinds of jobs, in one table: what each needs, its options, and the program that does it.

A new kind is one call of :func:`octasplat.workers.work.kinds.table.register`; the API, the workers and the
command line take it from there.
"""

from octasplat.workers.work.kinds import builtin as _builtin
from octasplat.workers.work.kinds.table import JobKind, job_kinds, kind_named, register

__all__ = ["JobKind", "job_kinds", "kind_named", "register"]

_builtin.register_all()
