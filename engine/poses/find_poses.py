"""Structure from motion on a folder of photographs, in a process that may die without harm."""

import contextlib
import json
import os
import select
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from octasplat.engine.core import versions
from octasplat.engine.core.errors import CancelledError, ColmapCrashError, DatasetError, DiskFullError
from octasplat.engine.core.events import (
    CheckpointWritten,
    Event,
    EventListener,
    PhaseFinished,
    PhaseProgress,
    PhaseStarted,
    ignore_events,
    parse_event,
)
from octasplat.engine.core.isolated_python import python_command
from octasplat.engine.core.writing import full_disk_error, replace_folder, write_json
from octasplat.engine.poses.config import (
    DEFAULT_CONFIG,
    FEATURES,
    FOUND_FOLDER,
    LENSES_STAGE,
    MAPPING_STAGE,
    MATCHES,
    PLACING_STAGE,
    RECORD_FILE,
    GivenModel,
    PosesConfig,
    PoseSearchRequest,
)
from octasplat.engine.poses.found_models import keep_other_models, read_pose_record
from octasplat.engine.poses.photographs import photographs_of_scene, photographs_sha256
from octasplat.engine.poses.stored_search import (
    SEARCH_FILE,
    STORED_FROM,
    is_stopped_search,
    search_folder,
    search_record,
    store_stopped_search,
)

_POLL_SECONDS = 0.5
_HEARTBEAT_SECONDS = 30.0
"""How often a step that takes long tells that it is alive."""
_LAST_STAGES = (MAPPING_STAGE, PLACING_STAGE, LENSES_STAGE)
"""Stages whose end says that the result is there: told once it is, as others store or show it then."""
_SINGLE_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def find_poses(
    images: Path,
    output: Path,
    *,
    names: Sequence[str] | None = None,
    config: PosesConfig = DEFAULT_CONFIG,
    threads: int = 0,
    progress: EventListener = ignore_events,
    should_stop: Callable[[], bool] = lambda: False,
) -> None:
    """Find where photographs were taken, and a sparse point cloud.

    There are four stages: ``read`` and ``features``, whose steps are photographs, ``matches``, whose steps
    are pairs of them, and ``poses``, whose steps are photographs again, the last one the number of those
    placed. Where photographs are left out, the last three may come a second time; a search that goes on has
    no ``read``, but for photographs in formats that COLMAP does not read, which are counted first. The same
    photographs give the same files on any number of threads. A result that is there already is taken as it
    is. A search that was stopped goes on with the features and matches that it had found, unless it was
    begun by a version with other results, of which a warning tells; so does one of 100 photographs and more
    in which COLMAP died, as for want of memory.

    Args:
        images: folder of photographs, also in folders below it if it is called ``images``.
        output: becomes the folder of the COLMAP model, with ``poses.json`` beside its files. Where the
            photographs fall apart, that is the model of most of them, and the others lie in folders below,
            see :mod:`octasplat.engine.poses.found_models`. What is needed on the way lies in a hidden folder
            next to it, which is removed when the search ends.
        names: of the photographs, relative to ``images``; None takes all.
        config: settings.
        threads: to use; 0 means all cores.
        progress: hears the progress.
        should_stop: asked now and then; True gives up.

    Raises:
        DatasetError: too few photographs, or they do not fit together; the text says what to do. Also if the
            result that is there is of other photographs.
        DiskFullError: the disk is full; the search goes on when there is space.
        ColmapCrashError: COLMAP died.
        CancelledError: stopped as asked.
    """
    if names is None:
        names = photographs_of_scene(images)
    sha256 = photographs_sha256(images, names)
    if output.is_dir():
        if read_pose_record(output).get("photographs_sha256", sha256) != sha256:
            raise DatasetError(
                f"{output} holds poses of other photographs than those in {images}; name another folder for "
                f"the results, or remove {output} to find them anew."
            )
        return
    is_long = len(names) >= STORED_FROM
    with _work_folder(output, search_record(sha256, config), progress, keeps_after_crash=is_long) as work:
        request = PoseSearchRequest(
            images=images.resolve(), names=tuple(names), work=work.resolve(), config=config, threads=threads
        )
        process = _ColmapProcess(request, progress, should_stop)
        try:
            process.wait()
        except CancelledError:
            is_kept = process.stage in (FEATURES, MATCHES) and is_long
            if is_kept and (stored := store_stopped_search(work)) is not None:
                progress(CheckpointWritten(process.step, str(stored)))
            raise
        record = read_pose_record(work / FOUND_FOLDER)
        found = {"photographs_sha256": sha256, versions.STATED: versions.RESULTS_VERSION}
        write_json(work / FOUND_FOLDER / RECORD_FILE, {**record, **found})
        (work / FOUND_FOLDER).rename(output)  # in one step: the folder is whole or is not there
        process.tell_end()


def repair_poses(
    images: Path,
    files: Sequence[str],
    given: GivenModel,
    output: Path,
    *,
    config: PosesConfig = DEFAULT_CONFIG,
    threads: int = 0,
    progress: EventListener = ignore_events,
    should_stop: Callable[[], bool] = lambda: False,
) -> tuple[str, ...]:
    """Move photographs of a model that do not stand where their matches with the others say.

    The stages are ``features``, ``matches``, whose steps are pairs of a photograph in doubt with another one,
    and ``placing``, whose steps are the photographs in doubt. All other poses stay as they are.

    Args:
        images: folder of the photographs.
        files: the photographs, below it.
        given: the model, their names in it, and which of them are in doubt.
        output: becomes the folder of the changed model, with ``poses.json`` beside its files; nothing is
            written where no photograph is moved.
        config: settings.
        threads: to use; 0 means all cores.
        progress: hears the progress.
        should_stop: asked now and then; True gives up.

    Returns:
        Names of the photographs that were moved.

    Raises:
        DatasetError: COLMAP refuses to work with the photographs or the model.
        ColmapCrashError: COLMAP died.
        CancelledError: stopped as asked.
    """
    with _work_folder(output) as work:
        request = PoseSearchRequest(
            images=images.resolve(),
            names=tuple(files),
            work=work.resolve(),
            config=config,
            threads=threads,
            given=given.model_copy(update={"model": given.model.resolve()}),
        )
        process = _ColmapProcess(request, progress, should_stop)
        process.wait()
        moved = tuple(read_pose_record(work / FOUND_FOLDER)["moved"])
        if moved:
            (work / FOUND_FOLDER).rename(output)
        process.tell_end()
    return moved


def adjust_principal_points(
    model: Path,
    output: Path,
    *,
    config: PosesConfig = DEFAULT_CONFIG,
    progress: EventListener = ignore_events,
    should_stop: Callable[[], bool] = lambda: False,
) -> dict[str, float] | None:
    """Estimate a principal point for each photograph, where that explains the observations far better.

    There is one stage, ``lenses``. See :mod:`octasplat.engine.poses.principal_points`.

    Args:
        model: folder of the COLMAP model.
        output: becomes the folder of the changed model, with ``poses.json`` beside its files; it may be the
            folder of the model that is changed. Nothing is written where the model stays as it is.
        config: settings.
        progress: hears the progress.
        should_stop: asked now and then; True gives up.

    Returns:
        ``reprojection_px_before`` and ``reprojection_px``, means over the points, and how far the principal
        points were moved, ``shift_px_median`` and ``shift_px_most``, at the size of the model; None where the
        model stays.

    Raises:
        DatasetError: COLMAP refuses to work with the model.
        ColmapCrashError: COLMAP died.
        CancelledError: stopped as asked.
    """
    before = read_pose_record(output)
    with _work_folder(output) as work:
        request = PoseSearchRequest(
            images=model.resolve(),  # no photograph is looked at
            names=(),
            work=work.resolve(),
            config=config,
            threads=1,
            lenses_of=model.resolve(),
        )
        process = _ColmapProcess(request, progress, should_stop)
        process.wait()
        facts: dict[str, float] | None = read_pose_record(work / FOUND_FOLDER)["lenses"]
        if facts is not None:
            write_json(work / FOUND_FOLDER / RECORD_FILE, {**before, "lenses": facts})
            keep_other_models(output, work / FOUND_FOLDER)
            replace_folder(output, work / FOUND_FOLDER)
        process.tell_end()
    return facts


@contextmanager
def _work_folder(
    output: Path,
    search: Mapping[str, Any] | None = None,
    progress: EventListener = ignore_events,
    *,
    keeps_after_crash: bool = False,
) -> Iterator[Path]:
    """Yield a hidden folder beside ``output``, removed when the block ends.

    Args:
        output: place of the result.
        search: what is searched for. The folder of the same search that was stopped is yielded as it was,
            and a block that is stopped, or finds the disk full, keeps it. None always begins with an empty
            folder.
        progress: told why a search that was stopped begins anew.
        keeps_after_crash: whether a search in which COLMAP dies keeps it, too.
    """
    work = search_folder(output)
    if search is None or not is_stopped_search(work, search, progress):
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir(parents=True)
        if search is not None:
            write_json(work / SEARCH_FILE, dict(search))
    is_kept = False
    try:
        yield work
    except (CancelledError, KeyboardInterrupt, DiskFullError):
        is_kept = search is not None
        raise
    except ColmapCrashError:
        is_kept = keeps_after_crash
        raise
    finally:
        if not is_kept:
            shutil.rmtree(work, ignore_errors=True)


class _ColmapProcess:
    """One process of COLMAP's, and what it says.

    Attributes:
        stage: that it is in.
        step: of the stage.
    """

    def __init__(
        self, request: PoseSearchRequest, progress: EventListener, should_stop: Callable[[], bool]
    ) -> None:
        self._request = request
        self._progress = progress
        self._should_stop = should_stop
        self.stage, self.step = "", 0
        self._last_progress: Event | None = None
        self._end: Event | None = None
        self._last_event_time = time.monotonic()
        self._error: DatasetError | DiskFullError | None = None
        self._is_done = False

    def wait(self) -> None:
        """Wait for the result, with progress and a check for requests to stop.

        Raises:
            CancelledError: stopped as asked.
            DatasetError: as the process says.
            ColmapCrashError: it said nothing and died.
        """
        log = self._request.work / "log.txt"
        with log.open("wb") as noise, _start_process(self._request, noise) as process:
            assert process.stdout is not None
            rest = b""
            while piece := self._read_chunk(process.stdout.fileno()):
                *lines, rest = (rest + piece).split(b"\n")
                for line in lines:
                    self._handle_line(line)
            code = process.wait()
        if self._error is not None:
            raise self._error
        if not self._is_done:
            crash = ColmapCrashError(_crash_message(code, self.stage, log))
            raise full_disk_error(self._request.work) or crash

    def tell_end(self) -> None:
        """Tell of the end of the last stage, once its result is where it belongs."""
        end, self._end = self._end, None
        if end is not None:
            self._forward_event(end)

    def _read_chunk(self, pipe: int) -> bytes:
        """Return the next bytes from the process; empty at its end."""
        while True:
            if self._should_stop():
                is_search = self._request.given is None and self._request.lenses_of is None
                how = "goes on where it was" if is_search else "begins them again"
                raise CancelledError(f"Stopped while finding poses; the same command with --resume {how}.")
            if select.select([pipe], [], [], _POLL_SECONDS)[0]:
                return os.read(pipe, 1 << 16)
            if (
                self._last_progress is not None
                and time.monotonic() - self._last_event_time > _HEARTBEAT_SECONDS
            ):
                self._forward_event(self._last_progress)

    def _handle_line(self, line: bytes) -> None:
        content = json.loads(line)
        kind = content.pop("kind")
        if kind == "done":
            self._is_done = True
        elif kind == "error":
            error = DiskFullError if content.get("is_disk_full") else DatasetError
            self._error = error(content["message"])
        elif (event := parse_event(kind, content)) is not None:
            if isinstance(event, PhaseStarted):
                self.tell_end()
            if isinstance(event, PhaseFinished) and event.stage in _LAST_STAGES:
                self._end = event  # what was found is still to be written
            else:
                self._forward_event(event)

    def _forward_event(self, event: Event) -> None:
        if isinstance(event, PhaseStarted):
            self.stage, self.step = event.stage, 0
            self._last_progress = PhaseProgress(event.stage, 0, event.total_steps)
        elif isinstance(event, PhaseProgress):
            self.step, self._last_progress = event.step, event
        elif isinstance(event, PhaseFinished):
            self._last_progress = None
        self._last_event_time = time.monotonic()
        self._progress(event)


@contextmanager
def _start_process(request: PoseSearchRequest, stderr_log: IO[bytes]) -> Iterator["subprocess.Popen[bytes]"]:
    """Start the process in the caller's process group; it is killed when the block ends."""
    # COLMAP has threads of its own.
    environment = {**os.environ, **dict.fromkeys(_SINGLE_THREAD_VARIABLES, "1")}
    process = subprocess.Popen(  # noqa: S603 - a program of ours
        python_command("octasplat.engine.poses.colmap_process"),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=stderr_log,
        env=environment,
    )
    assert process.stdin is not None and process.stdout is not None
    try:
        with contextlib.suppress(BrokenPipeError):  # it is dead, which is told soon
            process.stdin.write(request.model_dump_json().encode() + b"\n")
            process.stdin.flush()
        yield process
    finally:
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            with contextlib.suppress(OSError):
                pipe.close()


def _crash_message(code: int, stage: str, log: Path) -> str:
    placing = "placing photographs" if stage else "starting"
    known = {"read": "reading photographs", "features": "looking for features", "matches": "matching"}
    doing = (known | {"lenses": "adjusting lenses"}).get(stage, placing)
    how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
    text = log.read_text(encoding="utf-8", errors="replace") if log.exists() else ""
    said = next((line.strip()[:300] for line in reversed(text.splitlines()) if line.strip()), "")
    advice = (
        "the machine may have run out of memory: use fewer threads"
        if code == -signal.SIGKILL
        else "run the same command again"
    )
    return (
        f"COLMAP {how} while {doing}{f' (it said: {said})' if said else ''}; "
        f"{advice}, or send a COLMAP model."
    )
