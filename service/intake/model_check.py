"""Validation of a COLMAP model in a child process with limits."""

import logging
import os
import signal
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import ValidationError

from octasplat.engine.core.isolated_python import python_command
from octasplat.service.intake.faults import IntakeFault
from octasplat.service.intake.model_child import MAX_ANSWER_BYTES, ModelAnswer, ModelRequest
from octasplat.workers.storage.protocol import Storage
from octasplat.workers.storage.trees import TreeFile, fetch_tree
from octasplat.workers.worker.memory_limit import total_memory_bytes

MIN_VIEWS = 3
"""Fewer photographs do not make a scene; as in the engine."""

_log = logging.getLogger(__name__)
_LIBRARY_VARIABLES = ("PATH", "LANG", "LC_ALL", "LD_LIBRARY_PATH", "NUMBA_CACHE_DIR", "SYSTEMROOT")


@dataclass(frozen=True)
class ModelLimits:
    """Resource limits of parsing a COLMAP model.

    Attributes:
        memory_bytes: address space of the child; some 0.6 GB of it are the libraries. By default a quarter of
            the machine's memory, but 2 GiB at least and 6 GiB at most.
        cpu_seconds: processor time; a million points take some 7 s.
        seconds: time by the clock, several times as long, as a busy machine gives the child a part of one
            core.
        max_model_bytes: length of the model's files together.
        hidden: folders that the child cannot open.
    """

    memory_bytes: int = field(default_factory=lambda: min(6 << 30, max(2 << 30, total_memory_bytes() // 4)))
    cpu_seconds: int = 240
    seconds: int = 900
    max_model_bytes: int = 4 << 30
    hidden: tuple[Path, ...] = ()


def check_model(
    storage: Storage,
    model: Sequence[TreeFile],
    sizes_px: Mapping[str, tuple[int, int]],
    limits: ModelLimits = ModelLimits(),
) -> ModelAnswer:
    """Check a COLMAP model against the photographs of its dataset.

    Args:
        storage: holds the files of the model.
        model: files of its models, named as in the dataset.
        sizes_px: width and height of every photograph, by its name below ``images/``.
        limits: what parsing may take.

    Returns:
        What is wrong, or else what the model holds. Never raises for what the model contains.

    Raises:
        StorageError: the files cannot be had.
    """
    total = sum(file.size_bytes for file in model)
    if total > limits.max_model_bytes:
        detail = f"The COLMAP model has {total} bytes; {limits.max_model_bytes} are allowed."
        return ModelAnswer(faults=[IntakeFault("model-too-large", detail)])
    with tempfile.TemporaryDirectory(prefix="octasplat-model-") as folder:
        root = Path(folder)
        fetch_tree(storage, model, root, writable=True)  # copies, as the child is not trusted
        request = ModelRequest(
            root=root,
            files={file.path: file.path for file in model},
            sizes_px=dict(sizes_px),
            min_views=MIN_VIEWS,
            memory_bytes=limits.memory_bytes,
            cpu_seconds=limits.cpu_seconds,
            hidden=limits.hidden,
        )
        return _run_model_child(request, limits)


def _run_model_child(request: ModelRequest, limits: ModelLimits) -> ModelAnswer:
    # Files, not pipes: the child's limit on the length of files then bounds what it can say.
    with tempfile.TemporaryFile() as answer, tempfile.TemporaryFile() as noise:
        child = subprocess.Popen(  # noqa: S603 - a program of ours
            python_command("octasplat.service.intake.model_child"),
            stdin=subprocess.PIPE,
            stdout=answer,
            stderr=noise,
            env=parser_environment(),
            start_new_session=True,
            cwd="/",
        )
        try:
            child.communicate(request.model_dump_json().encode(), timeout=limits.seconds)
        except subprocess.TimeoutExpired:
            return _failed_answer(
                "model-timeout", f"Reading the COLMAP model took more than {limits.seconds} s."
            )
        finally:
            with suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
            child.wait()
        answer.seek(0)
        text = answer.read(MAX_ANSWER_BYTES)
        noise.seek(max(0, noise.seek(0, os.SEEK_END) - 2000))
        output = noise.read(2000)
    if child.returncode == -signal.SIGXCPU:
        return _failed_answer(
            "model-timeout",
            f"Reading the COLMAP model took more than {limits.cpu_seconds} s of processor time.",
        )
    if child.returncode == -signal.SIGKILL:
        _log.warning("the reader of a COLMAP model was killed: %a", output)
        return _failed_answer(
            "model-killed",
            "The reader of the COLMAP model was killed, perhaps for want of memory; try again later.",
        )
    try:
        return ModelAnswer.model_validate_json(text)
    except ValidationError:
        _log.warning("the reader of a COLMAP model ended with %s: %a", child.returncode, output)
        return _failed_answer(
            "model-crash", "The COLMAP model cannot be read (its reader crashed); write it anew with COLMAP."
        )


def parser_environment() -> dict[str, str]:
    """Return the environment of a child that parses untrusted data: library paths, no secrets."""
    inherited = {name: os.environ[name] for name in _LIBRARY_VARIABLES if name in os.environ}
    return {**inherited, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}


def _failed_answer(code: str, detail: str) -> ModelAnswer:
    return ModelAnswer(faults=[IntakeFault(code, detail)])
