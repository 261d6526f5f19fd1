"""Validation of a COLMAP model in a child process with limits."""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from octasplat.service.intake.faults import IntakeFault
from octasplat.service.intake.model_child import ModelAnswer, ModelRequest
from octasplat.service.intake.parser_process import ParserError, run_parser
from octasplat.workers.storage.protocol import Storage
from octasplat.workers.storage.trees import TreeFile, fetch_tree
from octasplat.workers.worker.memory_limit import total_memory_bytes

MIN_VIEWS = 3
"""Fewer photographs do not make a scene; as in the engine."""
CHILD = "octasplat.service.intake.model_child"


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
    try:
        return run_parser(CHILD, request, ModelAnswer, limits.seconds)
    except ParserError as error:
        return _failed_answer(
            *{
                "time": ("model-timeout", f"Reading the COLMAP model took more than {limits.seconds} s."),
                "cpu-time": (
                    "model-timeout",
                    f"Reading the COLMAP model took more than {limits.cpu_seconds} s of processor time.",
                ),
                "killed": (
                    "model-killed",
                    "The reader of the COLMAP model was killed, perhaps for want of memory; try again later.",
                ),
                "crash": (
                    "model-crash",
                    "The COLMAP model cannot be read (its reader crashed); write it anew with COLMAP.",
                ),
            }[error.reason]
        )


def _failed_answer(code: str, detail: str) -> ModelAnswer:
    return ModelAnswer(faults=[IntakeFault(code, detail)])
