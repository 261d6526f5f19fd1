"""Child processes that parse untrusted data, with limits: how they are started and what they answer.

What such a process does with its request is in :mod:`octasplat.service.intake.parser_child`.
"""

import logging
import os
import signal
import subprocess
import tempfile
from contextlib import suppress
from typing import Literal, TypeVar

from pydantic import BaseModel, ValidationError

from octasplat.engine.core.isolated_python import python_command
from octasplat.service.intake.parser_child import MAX_ANSWER_BYTES, ParserRequest

_log = logging.getLogger(__name__)
_LIBRARY_VARIABLES = ("PATH", "LANG", "LC_ALL", "LD_LIBRARY_PATH", "NUMBA_CACHE_DIR", "SYSTEMROOT")
AnswerT = TypeVar("AnswerT", bound=BaseModel)


class ParserError(Exception):
    """A child process that parses data gave no answer.

    Args:
        reason: ``time`` or ``cpu-time``, it took more than it may; ``killed``, from outside, perhaps for want
            of memory; ``crash``, by itself.
    """

    def __init__(self, reason: Literal["time", "cpu-time", "killed", "crash"]) -> None:
        super().__init__(reason)
        self.reason = reason


def run_parser(module: str, request: ParserRequest, answer: type[AnswerT], seconds: float) -> AnswerT:
    """Return what a child process answers; blocks.

    Args:
        module: of the child; its ``main`` calls :func:`octasplat.service.intake.parser_child.answer_request`.
        request: what it is to parse, and its limits.
        answer: model of the answer.
        seconds: time by the clock after which it is ended.

    Raises:
        ParserError: it gave no answer.
    """
    # Files, not pipes: the child's limit on the length of files then bounds what it can say.
    with (
        tempfile.TemporaryFile() as asked,
        tempfile.TemporaryFile() as said,
        tempfile.TemporaryFile() as noise,
    ):
        asked.write(request.model_dump_json().encode())
        asked.seek(0)
        child = subprocess.Popen(  # noqa: S603 - a program of ours
            python_command(module),
            stdin=asked,
            stdout=said,
            stderr=noise,
            env=parser_environment(),
            start_new_session=True,
            cwd="/",
        )
        try:
            child.wait(seconds)
        except subprocess.TimeoutExpired:
            raise ParserError("time") from None
        finally:
            with suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
            child.wait()
        said.seek(0)
        text = said.read(MAX_ANSWER_BYTES)
        noise.seek(max(0, noise.seek(0, os.SEEK_END) - 2000))
        output = noise.read(2000)
    if child.returncode == -signal.SIGXCPU:
        raise ParserError("cpu-time")
    if child.returncode == -signal.SIGKILL:
        _log.warning("%s was killed: %a", module, output)
        raise ParserError("killed")
    try:
        return answer.model_validate_json(text)
    except ValidationError:
        _log.warning("%s ended with %s: %a", module, child.returncode, output)
        raise ParserError("crash") from None


def parser_environment() -> dict[str, str]:
    """Return the environment of a child that parses untrusted data: library paths, no secrets."""
    inherited = {name: os.environ[name] for name in _LIBRARY_VARIABLES if name in os.environ}
    return {**inherited, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
