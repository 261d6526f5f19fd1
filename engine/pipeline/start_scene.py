"""The scene that a training begins with instead of Gaussians on the sparse points: that of another run.

It is copied into the folder of the new run before anything else, so that the run can be resumed when the
other one has gone on or is gone.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from pydantic import BaseModel

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.events import EventListener, Noted, Warned
from octasplat.engine.core.local_origin import NO_ORIGIN, Origin
from octasplat.engine.core.writing import write_json
from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.photograph_files import image_folder
from octasplat.engine.dataset.views_file import ViewsRecord, read_views, write_views
from octasplat.engine.files import read_metadata, read_scene
from octasplat.engine.gaussians.channels import Channels
from octasplat.engine.gaussians.merge import about_origin, with_sh_degree
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.poses.found_models import copy_found_models, read_pose_record
from octasplat.engine.poses.photographs import photographs_of_scene, photographs_sha256
from octasplat.engine.runs.config import read_config
from octasplat.engine.runs.finished_shading import finished_shading
from octasplat.engine.runs.run_folder import (
    CHECKPOINTS,
    CONFIG,
    POSES,
    SCENE,
    START,
    VIEWS,
    is_run,
    run_origin,
)
from octasplat.engine.train.config import TrainConfig, max_gaussian_count
from octasplat.engine.train.initialization.initial_gaussians import (
    add_initial_materials,
    initial_train_state,
)
from octasplat.engine.train.loop.checkpoint import (
    BestState,
    latest_checkpoint,
    load_best,
    load_checkpoint,
    save_best,
)
from octasplat.engine.train.loop.state import TrainState
from octasplat.engine.train.loop.validation_probe import is_best_exported
from octasplat.engine.train.sampling.pixel_sampler import valid_pixel_fraction
from octasplat.engine.train.shading_factory import ShadingOptions, make_shading

_RECORD = "start.json"
_NO_CORRECTIONS = np.zeros((0, 6))


class _StartRecord(BaseModel):
    """Where the scene is from, its number of Gaussians, and the origin about which its positions are."""

    source: str
    count: int
    origin_world: tuple[float, float, float]


def keep_start(scene: Path, output: Path, source: Path | None, *, is_new: bool) -> None:
    """Copy the scene that a new run begins with into its folder, or check that a run was begun with it.

    Args:
        scene: folder of the photographs.
        output: folder of the run.
        source: folder of a run, finished or stopped, or a file of Gaussians; None for none, or to resume as
            it was begun.
        is_new: whether the run is begun now.

    Raises:
        ConfigError: there is nothing to begin with, its poses are those of other photographs, or the run was
            begun otherwise.
        SceneFileError: the scene cannot be read.
        CheckpointError: the newest checkpoint of the run is damaged.
    """
    folder, path = output / START, output / START / _RECORD
    if source is None:
        if folder.is_dir() and not path.exists():
            raise ConfigError(
                f"The run in {output} was stopped before it had what it begins with; repeat --start-from."
            )
        return
    if not is_new and (output / VIEWS).exists():
        kept = _read_record(output).source if path.exists() else None
        if kept != str(source.resolve()):
            raise ConfigError(
                f"The run in {output} was not begun with {source}; leave --start-from out to go on with it, "
                "or name another folder."
            )
        return
    state, origin_world = _read_source(source)
    folder.mkdir(exist_ok=True)
    save_best(state, folder)
    if is_run(source):
        _copy_found_poses(scene, output, source)
        if (source / VIEWS).exists():
            write_views(folder / VIEWS, read_views(source / VIEWS))
    record = _StartRecord(source=str(source.resolve()), count=len(state.gaussians), origin_world=origin_world)
    write_json(path, record.model_dump(mode="json"))  # last, as it says that all is there


def has_start(output: Path) -> bool:
    """Return whether a run begins with a scene of another run."""
    return (output / START).is_dir()


def check_start(output: Path, dataset: Dataset, config: TrainConfig, progress: EventListener) -> None:
    """Check that the scene suits the photographs; warn of views that it was trained on and are held out now.

    Raises:
        ConfigError: it stands in another world, or has more Gaussians than the run may have.
    """
    record = _read_record(output)
    source, count = record.source, record.count
    allowed = max_gaussian_count(config, dataset.train_pixel_count, valid_pixel_fraction(dataset))
    if count > allowed:
        raise ConfigError(
            f"{source} has {count:,} Gaussians, and this run may have {allowed:,}; allow more by "
            f"--max-gaussians {count}."
        )
    before = _views_of_start(output)
    if before is None:
        return
    if before.is_of_another_world(dataset.views_record):
        raise ConfigError(
            f"The photographs have other poses than {source} was trained with; name a folder whose model "
            "stands in the same world."
        )
    now = {view.name: view.held_out for view in dataset.views_record.views}
    shared = [view for view in before.views if view.name in now]
    if not shared:
        progress(
            Warned(f"{source} has none of these photographs; nothing shows that both stand in one world.")
        )
    if seen := [view.name for view in shared if now[view.name] and not view.held_out]:
        more = f" and {len(seen) - 3} more" if len(seen) > 3 else ""
        progress(
            Warned(
                f"{source} was trained on views that are held out here ({', '.join(seen[:3])}{more}): their "
                "PSNR will be too good."
            )
        )


def started_state(
    output: Path, dataset: Dataset, config: TrainConfig, threads: int, progress: EventListener
) -> TrainState:
    """Return the state before the first iteration, with the Gaussians of the other run.

    Exposures, background and environment are taken over where both runs learn the same of the same views.

    Args:
        output: folder of the run.
        dataset: the photographs.
        config: all settings of the training.
        threads: work side by side, which changes nothing that is made.
        progress: told what is learnt anew.

    Raises:
        CheckpointError: the copy of the scene is damaged.
    """
    kept = load_best(output / START)
    origin_world = _read_record(output).origin_world
    gaussians = about_origin(kept.gaussians, origin_world, dataset.origin_world).copy()
    if gaussians.sh_degree > config.sh_degree:
        gaussians = with_sh_degree(gaussians, config.sh_degree)
    gaussians = _with_channels_for(config, gaussians, progress)
    state = initial_train_state(dataset, config, threads=threads, gaussians=gaussians)
    before = _views_of_start(output)
    if before is None or before.difference(_as_before(dataset.views_record, before)) is not None:
        return state
    fresh = make_shading(ShadingOptions.from_config(config), len(dataset.views), dataset.extent).state()
    if _shapes(fresh) == _shapes(kept.shading):
        state.shading = dict(kept.shading)
    elif kept.shading:
        progress(
            Noted("What was learnt of exposures, background and light is learnt anew, by other settings.")
        )
    if config.refine_poses and len(kept.pose_corrections):
        state.pose_corrections = kept.pose_corrections
    elif np.any(kept.pose_corrections):
        progress(Noted("The other run refined its poses, and this one trains with those of the model."))
    return state


def _as_before(views: ViewsRecord, before: ViewsRecord) -> ViewsRecord:
    """Return views about another record's origin; depth maps tell nothing of exposures or light."""
    moved = views.about(before.origin_world)
    return moved.model_copy(update={"depths_sha256": before.depths_sha256})


def _read_source(source: Path) -> tuple[BestState, Origin]:
    """Return what a run or a file holds, and the origin about which its positions are."""
    if not is_run(source):
        return BestState(read_scene(source)[0], {}, _NO_CORRECTIONS), read_metadata(source).origin_world
    newest = latest_checkpoint(source / CHECKPOINTS)
    if newest is None and not (source / SCENE).exists():
        raise ConfigError(
            f"{source} has neither {SCENE} nor a checkpoint, so that nothing can be begun with it; name "
            "another run, or leave --start-from out."
        )
    shading: dict[str, np.ndarray] = {}
    corrections: Float64[np.ndarray, "v 6"] = _NO_CORRECTIONS
    gaussians: FlatGaussians | None = None
    if newest is not None:
        state = load_checkpoint(newest)
        gaussians, shading, corrections = state.gaussians, state.shading, state.pose_corrections
        if _shows_best_state(source, state):
            best = load_best(source / CHECKPOINTS)
            shading, corrections = dict(best.shading), best.pose_corrections
    else:  # an edited run has none, and those of a finished one may have been deleted
        shading = _shading_of_results(source)
    if (source / SCENE).exists():
        gaussians = read_scene(source / SCENE)[0]
    assert gaussians is not None
    return BestState(gaussians, shading, corrections), run_origin(source) or NO_ORIGIN


def _shows_best_state(source: Path, last: TrainState) -> bool:
    """Return whether the scene of a finished run is its best state, as the last one was much worse.

    Exposures, background, light and poses are then those of that state, too.
    """
    if not ((source / SCENE).exists() and (source / CONFIG).exists() and last.probes):
        return False
    margin_db = read_config(source / CONFIG).train.best_checkpoint_margin_db
    return is_best_exported(last.probes[-1][1], last.best_psnr, margin_db)


def _shading_of_results(source: Path) -> dict[str, np.ndarray]:
    """Return exposures, background and light that the files of a finished run hold; empty if they do not."""
    if not ((source / CONFIG).exists() and (source / VIEWS).exists()):
        return {}
    views = read_views(source / VIEWS)
    options = ShadingOptions.from_config(read_config(source / CONFIG).train)
    names = [view.name for view in views.views]
    try:
        return dict(finished_shading(source, options, views.extent_world, names).state())
    except ConfigError:  # a file is gone: all is learnt anew
        return {}


def keep_found_models(scene: Path, output: Path, source: Path | None) -> None:
    """Copy the models that another run has found, so that none are searched.

    Args:
        scene: folder of the photographs.
        output: folder of the run.
        source: folder of the other run; None for none.

    Raises:
        ConfigError: it has found none, or those of other photographs.
    """
    if source is None or (output / POSES).exists():
        return
    if "photographs_sha256" not in read_pose_record(source / POSES):
        raise ConfigError(f"{source} holds no poses that a search has found; name the folder of such a run.")
    _copy_found_poses(scene, output, source)


def _copy_found_poses(scene: Path, output: Path, source: Path) -> None:
    """Copy poses that were found, as those of another search would be in another world."""
    digest = read_pose_record(source / POSES).get("photographs_sha256")
    if digest is None or (output / POSES).exists():
        return
    if photographs_sha256(image_folder(scene), photographs_of_scene(scene)) != digest:
        raise ConfigError(
            f"The poses of {source} were found for other photographs than those in {scene}, and poses found "
            "anew would be in another world; give the same photographs, or a COLMAP model of these in that "
            "world."
        )
    copy_found_models(source / POSES, output / POSES)


def _with_channels_for(
    config: TrainConfig, gaussians: FlatGaussians, progress: EventListener
) -> FlatGaussians:
    """Return the Gaussians with the channels that the training has, and no others; tell of those left out."""
    own, result = gaussians.channels, replace(gaussians, channels=Channels())
    if config.materials.learn:
        first = add_initial_materials(result, config.materials)
        fitting = {
            name: own[name] if own.widths.get(name) == width else first.channels[name]
            for name, width in first.channels.widths.items()
        }
        result = replace(first, channels=Channels(fitting))
    if left_out := sorted(own.keys() - result.channels.keys()):
        progress(
            Noted(f"The scene that this run begins with has {', '.join(left_out)}, which are not trained.")
        )
    return result


def _views_of_start(output: Path) -> ViewsRecord | None:
    path = output / START / VIEWS
    return read_views(path) if path.exists() else None


def _read_record(output: Path) -> _StartRecord:
    return _StartRecord.model_validate_json((output / START / _RECORD).read_text(encoding="utf-8"))


def _shapes(arrays: Mapping[str, np.ndarray]) -> dict[str, tuple[int, ...]]:
    return {name: np.shape(value) for name, value in arrays.items()}
