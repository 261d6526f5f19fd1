"""Hooks of schemathesis: most requests name things that exist, or nothing but 404 would be met.

``OCTASPLAT_TEST_IDS`` names a file that maps each path parameter to ids. Those under ``used`` may be changed
and deleted, so each serves one request; those under ``kept`` are for reading.
"""

import itertools
import json
import os
from pathlib import Path
from typing import Any

import schemathesis

_IDS = json.loads(Path(os.environ["OCTASPLAT_TEST_IDS"]).read_text())
_USED = {name: itertools.cycle(ids) for name, ids in _IDS["used"].items()}
_KEPT = {name: itertools.cycle(ids) for name, ids in _IDS["kept"].items()}
_COUNT = itertools.count()


@schemathesis.hook
def before_call(_context: schemathesis.HookContext, case: schemathesis.Case, **_kwargs: Any) -> None:
    if next(_COUNT) % 8 == 0 or not case.path_parameters:
        return
    pool = _KEPT if case.method.upper() in ("GET", "HEAD") else _USED
    for name in case.path_parameters:
        if name in pool:
            case.path_parameters[name] = next(pool[name])


schemathesis.serializer.alias("application/zip", "application/octet-stream")
