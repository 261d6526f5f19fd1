"""The folder of a run: claimed before the work, and released if the work is refused."""

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from octasplat.engine.core.errors import (
    CheckpointError,
    ColmapCrashError,
    ConfigError,
    DatasetError,
    OutputError,
    SceneFileError,
)
from octasplat.engine.core.portable_names import is_text
from octasplat.engine.core.relative_paths import normalize_name
from octasplat.engine.core.versions import package_versions
from octasplat.engine.core.writing import write_json
from octasplat.engine.dataset.model_sources import has_model
from octasplat.engine.poses.found_models import read_pose_record
from octasplat.engine.runs.config import GIVEN, ReconstructionConfig, read_config
from octasplat.engine.runs.run_folder import BLOCKS, CACHE, CONFIG, EVENTS, POSES, START


def claim_output(
    scene: Path,
    output: Path,
    config: ReconstructionConfig,
    resume: bool,
    *,
    given: Sequence[str] | None = None,
) -> bool:
    """Create the folder and its ``config.json``, or check that it is the run to resume.

    Args:
        scene: folder of the photographs.
        output: the folder.
        config: all settings.
        resume: whether it may be a run that is there.
        given: names of the settings that a new run was given; None where that is not known.

    Returns:
        Whether the run is new.

    Raises:
        OutputError: the folder holds something else or cannot be written.
        ConfigError: the run in it has other settings.
    """
    if output.exists() and not output.is_dir():
        raise OutputError(f"{output} is a file; name a folder for the results.")
    if not is_text(output.absolute()):  # else its pictures could not be written in the end
        raise OutputError(f"{output}: the path is no text; name another folder for the results.")
    if (output / CONFIG).exists():
        if not resume:
            raise OutputError(
                f"{output} already holds a run; add --resume to go on with it, or name another folder."
            )
        _check_settings(scene, output, config)
        return False
    if output.is_dir() and not _is_unclaimed(
        output, config.with_poses_decided(has_model(scene)).poses == "auto"
    ):
        raise OutputError(f"{output} is not empty and holds no run; name an empty or a new folder.")
    try:
        output.mkdir(parents=True, exist_ok=True)
        for left in output.glob(".*.partial.*"):  # by a run that was killed while it wrote
            left.unlink()
        write_config(scene, output, config, given=given)
    except OSError as error:
        raise OutputError(
            f"{output} cannot be written to ({error.strerror or error}); name another folder."
        ) from None
    return True


@contextmanager
def release_on_refusal(output: Path, *, is_new: bool, is_made: bool) -> Iterator[None]:
    """Release the folder of a new run if its photographs or settings are refused, for the corrected command.

    So it is where COLMAP has crashed, for the same command. The decoded photographs stay, and poses that were
    found: the next command goes on with them.

    Args:
        output: the folder.
        is_new: whether the run was begun by this command.
        is_made: whether the folder was made by it, too.
    """
    try:
        yield
    except (DatasetError, ConfigError, SceneFileError, CheckpointError, ColmapCrashError):
        if is_new:
            (output / CONFIG).unlink()
            (output / EVENTS).unlink(missing_ok=True)
            for name in (BLOCKS, START):
                shutil.rmtree(output / name, ignore_errors=True)
            if not _is_from_pose_search(output / POSES):
                shutil.rmtree(output / POSES, ignore_errors=True)
            if is_made:
                with suppress(OSError):  # it holds something
                    output.rmdir()
        raise


def _is_unclaimed(output: Path, finds_poses: bool) -> bool:
    """Return whether a folder is empty, or holds only the remains of a refused start."""
    for path in output.iterdir():
        # caches of a refused start are taken over
        if path.name == CACHE and path.is_dir():
            if not all(file.suffix in (".bin", ".json") for file in path.iterdir()):
                return False
        elif path.name == POSES and finds_poses:
            if not _is_from_pose_search(path):
                return False
        elif not path.name.startswith("."):
            return False
    return True


def _is_from_pose_search(poses: Path) -> bool:
    """Return whether poses are those of a search, which records its photographs."""
    return "photographs_sha256" in read_pose_record(poses)


def write_config(
    scene: Path,
    output: Path,
    config: ReconstructionConfig,
    *,
    given: Sequence[str] | None,
    decided: Mapping[str, str] | None = None,
) -> None:
    """Write ``config.json``: the photographs' place, all settings, and the versions of the software.

    Args:
        scene: folder of the photographs.
        output: the folder.
        config: all settings.
        given: names of those that were given, see :func:`octasplat.engine.runs.config.given_settings`; None
            where that is not known.
        decided: what the run has decided by itself, by name.
    """
    content = {
        "scene": str(scene.resolve()),
        "reconstruction": config.model_dump(mode="json"),
        **({} if given is None else {GIVEN: list(given)}),
        "versions": package_versions(),
        **(decided or {}),
    }
    write_json(output / CONFIG, content)


def _check_settings(scene: Path, output: Path, config: ReconstructionConfig) -> None:
    """Check that settings are the run's own, apart from the files to export."""
    is_posed = has_model(scene)
    before = read_config(output / CONFIG).model_copy(update={"exports": config.exports})
    if _normalize_config(before, is_posed) != _normalize_config(config, is_posed):
        raise other_settings_error(output)


def other_settings_error(output: Path) -> ConfigError:
    """Return what to say of a command whose settings are not those of the run in a folder."""
    return ConfigError(
        f"{output / CONFIG} has other settings than this command; without any option --resume takes those of "
        "the run. Or name another folder."
    )


def _normalize_config(config: ReconstructionConfig, is_posed: bool) -> ReconstructionConfig:
    """Return settings in one spelling, so that equal meanings compare equal."""
    held_out = None if config.held_out is None else tuple(sorted(map(normalize_name, config.held_out)))
    return config.with_poses_decided(is_posed).model_copy(update={"held_out": held_out})
