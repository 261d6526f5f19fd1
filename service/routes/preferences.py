"""The header ``Prefer`` (RFC 7240): how long the answer to a request waits for what it began."""

import re
from typing import Annotated

from fastapi import Header

from octasplat.service.settings import MAX_WAIT_SECONDS

Prefer = Annotated[
    str | None,
    Header(
        alias="Prefer",
        max_length=1000,
        description="`respond-async` answers at once, `wait=N` after so many seconds at most (RFC 7240), "
        f"which are no more than {MAX_WAIT_SECONDS}.",
    ),
]
_WAIT = re.compile(r'wait\s*=\s*"?(\d{1,6})"?', re.IGNORECASE)


def seconds_to_wait(prefer: str | None, default: float) -> float:
    """Return for how many seconds an answer waits; what is not understood is ignored."""
    is_async = False
    for preference in (prefer or "").split(","):
        name = preference.partition(";")[0].strip()
        if (found := _WAIT.fullmatch(name)) is not None:
            return float(min(int(found[1]), MAX_WAIT_SECONDS))
        is_async = is_async or name.lower() == "respond-async"
    return 0.0 if is_async else default
