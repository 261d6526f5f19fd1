"""Structure from motion on a folder of photographs, in a process that may die without harm."""

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from octasplat.engine.core import versions
from octasplat.engine.core.errors import CancelledError, ColmapCrashError, DatasetError, DiskFullError
from octasplat.engine.core.events import CheckpointWritten, EventListener, ignore_events
from octasplat.engine.core.writing import replace_folder, write_json
from octasplat.engine.poses.config import (
    DEFAULT_CONFIG,
    FEATURES,
    FOUND_FOLDER,
    MATCHES,
    RECORD_FILE,
    GivenModel,
    PosesConfig,
    PoseSearchRequest,
)
from octasplat.engine.poses.found_models import keep_other_models, read_pose_record
from octasplat.engine.poses.photographs import photographs_of_scene, photographs_sha256
from octasplat.engine.poses.running_colmap import ColmapProcess
from octasplat.engine.poses.stored_search import (
    SEARCH_FILE,
    STORED_FROM,
    is_stopped_search,
    search_folder,
    search_record,
    store_stopped_search,
)


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
        process = ColmapProcess(request, progress, should_stop)
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
        given: the model, the names of its photographs, and which of them are in doubt.
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
        process = ColmapProcess(request, progress, should_stop)
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
        process = ColmapProcess(request, progress, should_stop)
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
