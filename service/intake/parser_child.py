"""What child processes that parse untrusted data have in common.

They limit their own memory, time and output, and give up the network, other programs and writing, before they
import anything that parses. The parent is :mod:`octasplat.service.intake.parser_process`.
"""

import contextlib
import os
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel

from octasplat.workers.sandbox.confinement import confine
from octasplat.workers.sandbox.linux import PR_SET_PDEATHSIG, prctl

MAX_ANSWER_BYTES = 4 << 20


class ParserRequest(BaseModel):
    """Request to a child process that parses data.

    Attributes:
        root: folder that holds what is to be parsed and nothing else.
        memory_bytes: address space.
        cpu_seconds: processor time.
        hidden: folders that are nothing to it.
    """

    root: Path
    memory_bytes: int
    cpu_seconds: int
    hidden: tuple[Path, ...] = ()

    def without_root(self, sentence: str) -> str:
        """Return a sentence without the folder of this machine that holds what is parsed."""
        return sentence.replace(f"{self.root}/", "").replace(str(self.root), "the dataset")


RequestT = TypeVar("RequestT", bound=ParserRequest)


def answer_request(request: type[RequestT], parse: Callable[[RequestT], BaseModel]) -> None:
    """Read a request from stdin, give up rights, parse, and write the answer to stdout."""
    answer_fd = os.dup(1)
    os.dup2(2, 1)  # libraries that talk do so to stderr
    asked = request.model_validate_json(sys.stdin.buffer.read())
    _enter_sandbox(asked)
    text = parse(asked).model_dump_json().encode()
    with os.fdopen(answer_fd, "wb") as out:
        out.write(text)


def _enter_sandbox(request: ParserRequest) -> None:
    """Give up rights that a parser does not need, for good."""
    # The parent ends it where it takes too long, unless it was killed itself.
    with contextlib.suppress(OSError):
        prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    for kind, soft, hard in (
        (resource.RLIMIT_AS, request.memory_bytes, request.memory_bytes),
        # At the soft limit SIGXCPU comes, which the parent can tell from a SIGKILL for other reasons.
        (resource.RLIMIT_CPU, request.cpu_seconds, request.cpu_seconds + 1),
        (resource.RLIMIT_FSIZE, MAX_ANSWER_BYTES, MAX_ANSWER_BYTES),
        (resource.RLIMIT_CORE, 0, 0),
    ):
        with contextlib.suppress(ValueError):  # already lower
            resource.setrlimit(kind, (soft, hard))
    confine(hidden=request.hidden, readable=(request.root,), may_start_processes=False)
