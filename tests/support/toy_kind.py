"""A kind of job that counts, with everything that can go wrong on request; workers under test import it."""

import os
import signal
import time
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from octasplat.engine.core.errors import CancelledError, DatasetError
from octasplat.engine.core.events import CheckpointWritten, PhaseFinished, PhaseProgress, PhaseStarted, Warned
from octasplat.workers.worker.job_kinds import JobKind, register
from octasplat.workers.worker.task import Task

if Path(os.environ.get("XDG_CACHE_HOME", "/nowhere"), "broken").exists():
    raise ImportError("a library is broken on this machine")


class ToyOptions(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    steps: int = 10
    seconds: float = 0.02
    checkpoint_every: int = 5
    crash_at: int | None = None
    refuse: bool = False
    say_nul: bool = False
    """Refuses with what a database cannot hold."""
    fault: bool = False
    silent_at: int | None = None
    hog_bytes: int = 0
    fill_bytes: int = 0
    """Written to its folder at the beginning of every attempt."""
    result_bytes: int = 0
    log_lines: int = 0
    hold_at: int | None = None
    """Goes on beyond this step once the file ``gate`` is there."""
    gate: str = ""
    hog_behind_gate_bytes: int = 0
    silent_behind_gate: bool = False
    deaf: bool = False
    tell_paths: bool = False
    """Fails over a file, with paths in everything it says."""


def _hold(task: Task, options: ToyOptions, hog: bytearray) -> None:
    told = False
    while not Path(options.gate).exists():
        if task.should_stop():
            if not options.deaf:
                return
            if not told:
                print("the toy hears and does not heed", flush=True)  # noqa: T201
                told = True
        task.progress(PhaseProgress("train", options.hold_at or 0, options.steps))
        time.sleep(0.05)
    hog.extend(b"x" * options.hog_behind_gate_bytes)
    while options.silent_behind_gate or options.hog_behind_gate_bytes:
        time.sleep(0.02)


def run(task: Task) -> None:
    options = ToyOptions.model_validate(task.options)
    if options.refuse:
        raise DatasetError("The toy refuses this scene; send another.")
    if options.say_nul:
        task.progress(Warned("a header with \0 and \ud800"))
        raise DatasetError("The header \0 \udfff is odd.")
    if options.tell_paths:
        inner, sheet = task.run / "cache" / "pixels.bin", task.run / "images" / "a b.jpg"
        print(f"[x.cc:12] Cannot open:{inner}, file://{inner}; see https://example.org/home/x")  # noqa: T201
        task.progress(PhaseStarted("load", 3))
        task.progress(Warned(f"{sheet} is dark; {__file__} says so."))
        task.progress(PhaseFinished("load", 2.0))
        try:
            inner.open("rb")
        except OSError as error:
            raise DatasetError(f"{inner} cannot be read.") from error
    if options.fault:
        raise RuntimeError("a fault of the program")
    checkpoints = task.run / "checkpoints"
    checkpoints.mkdir(parents=True, exist_ok=True)
    newest = max(checkpoints.glob("iteration_*.npz"), default=None)
    step = int(newest.read_text()) if newest else 0
    with (task.run / "events.jsonl").open("a") as history:
        history.write(f"{step}\n")
    hog = bytearray(options.hog_bytes)
    hog[::4096] = b"x" * len(hog[::4096])
    with (task.run / "filled").open("wb") as filled:
        for _ in range(options.fill_bytes >> 16):
            filled.write(os.urandom(1 << 16))
    print(f"the toy begins at {step}", flush=True)  # noqa: T201 - as a library might
    for number in range(options.log_lines):
        print(f"line {number} of a library that cannot stop talking")  # noqa: T201
    task.progress(PhaseStarted("train", options.steps))
    while step < options.steps:
        time.sleep(options.seconds)
        step += 1
        if options.crash_at == step:
            os.kill(os.getpid(), signal.SIGSEGV)
        if options.silent_at == step:
            time.sleep(3600)
        task.progress(PhaseProgress("train", step, options.steps))
        if options.hold_at == step:
            _hold(task, options, hog)
        stop = task.should_stop() and not options.deaf
        if stop or step % options.checkpoint_every == 0:
            path = checkpoints / f"iteration_{step:07d}.npz"
            path.with_suffix(".tmp").write_text(str(step))
            path.with_suffix(".tmp").rename(path)
            task.progress(CheckpointWritten(step, str(path)))
        if stop and step < options.steps:
            raise CancelledError("stopped")
    task.progress(PhaseFinished("train", 1.0))
    (task.results / "sum.txt").write_text(str(sum(range(options.steps + 1))))
    if options.result_bytes:
        (task.results / "large.bin").write_bytes(os.urandom(options.result_bytes))
    (task.results / "history.txt").write_text((task.run / "events.jsonl").read_text())


register(
    JobKind(
        name="toy",
        title="Counts",
        needs="dataset",
        options=ToyOptions,
        program="tests.support.toy_kind:run",
        stages=("train",),
    )
)
