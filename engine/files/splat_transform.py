"""The converter ``@playcanvas/splat-transform``, run as a program of its own where somebody installed it."""

import math
import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from octasplat.engine.core.errors import SceneFileError

PACKAGE = "@playcanvas/splat-transform"
PROGRAM = "splat-transform"
PROGRAM_VARIABLE = "OCTASPLAT_SPLAT_TRANSFORM"
"""Environment variable that names the program where it is not on the PATH."""
TIMEOUT_SECONDS = 1800


def find_converter() -> Path | None:
    """Return the program, or None where there is none."""
    named = os.environ.get(PROGRAM_VARIABLE)
    if named:
        return Path(named) if Path(named).exists() else None
    found = shutil.which(PROGRAM)
    return Path(found) if found else None


def missing_converter() -> str | None:
    """Return what to do about the program being missing, or None where it is there."""
    if find_converter() is not None:
        return None
    return (
        f"needs the program {PROGRAM}; install node and then it with npm install -g {PACKAGE}, "
        f"or name it in {PROGRAM_VARIABLE}"
    )


def convert(source: Path, target: Path, *options: str) -> None:
    """Convert ``source`` to ``target``, whose suffixes say the formats; no GPU is used.

    Args:
        source: file to read.
        target: file to write, replaced if it exists.
        options: further options of the program.

    Raises:
        SceneFileError: the program is missing, fails, or writes nothing.
    """
    _run(target, [*options, str(source.resolve())])


def convert_levels(levels: Sequence[Path], target: Path, *, chunk_extent_world: float) -> None:
    """Pack levels of detail into a streamed SOG.

    Args:
        levels: files to read, the finest first.
        target: its ``lod-meta.json``; chunks are written beside it.
        chunk_extent_world: about the largest side of a chunk, world units.

    Raises:
        SceneFileError: the program is missing, fails, or writes nothing.
    """
    tagged = [word for k, level in enumerate(levels) for word in (str(level.resolve()), "-l", str(k))]
    _run(target, ["-X", str(max(1, math.ceil(chunk_extent_world))), *tagged])  # which takes no fractions


def _run(target: Path, arguments: Sequence[str]) -> None:
    """Run the program on what is to be read and the target."""
    program = find_converter()
    if program is None:
        raise SceneFileError(f"{target}: {missing_converter()}.")
    # Quiet, overwriting, without a GPU
    command = [str(program), "-q", "-w", "-g", "cpu", *arguments, str(target.resolve())]
    try:
        done = subprocess.run(  # noqa: S603 - no shell, and the paths are absolute
            command, capture_output=True, text=True, timeout=TIMEOUT_SECONDS, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise SceneFileError(f"{target}: {program.name} could not be run ({error}).") from error
    if done.returncode != 0 or not target.exists():
        words = " ".join((done.stderr or done.stdout).split())[-300:]
        raise SceneFileError(f"{target}: {program.name} failed ({words or done.returncode}).")
