"""Operations, one module per verb: a typed request, and ``run``, which executes it.

A request is the only place where an option is defined. The options of the command, the type of the job, the
form of the page, the OpenAPI schema and the Python call are all made from it. Requests import neither torch
nor numba; ``run`` imports what it needs when it is called.
"""

from octasplat.engine.operations.base import Operation, Options, Request, Result, ScenesWritten
from octasplat.engine.operations.registry import operation, operation_names, operations

__all__ = [
    "Operation",
    "Options",
    "Request",
    "Result",
    "ScenesWritten",
    "operation",
    "operation_names",
    "operations",
]
