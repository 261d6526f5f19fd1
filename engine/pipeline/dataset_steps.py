"""Steps before the training: pose search, and opening of the dataset."""

from dataclasses import dataclass

from octasplat.engine.blocks.block_photographs import read_block_photographs
from octasplat.engine.core.events import Noted, Warned
from octasplat.engine.core.georeference import GEOREFERENCE_FILE, write_georeference
from octasplat.engine.core.progress import phase
from octasplat.engine.dataset import Dataset, write_held_out
from octasplat.engine.dataset.views_file import write_views
from octasplat.engine.georeference.find_georeference import find_georeference
from octasplat.engine.georeference.request import read_request
from octasplat.engine.pipeline.material_choice import rewrite_config
from octasplat.engine.pipeline.run import ReconstructionRun, run_steps
from octasplat.engine.pipeline.start_scene import check_start, has_start
from octasplat.engine.poses.photographs import notes_on_files
from octasplat.engine.runs.config import read_config
from octasplat.engine.runs.run_dataset import open_run_dataset, open_run_part
from octasplat.engine.runs.run_folder import (
    BLOCKS,
    CONFIG,
    HELD_OUT,
    VIEWS,
    dataset_folder_of_run,
    found_model_folder,
)
from octasplat.engine.runs.run_poses import (
    estimate_principal_points,
    find_missing_poses,
    repair_run_poses,
    tell_of_former_poses,
    warn_of_other_models,
)
from octasplat.engine.train.sampling.batches import BatchOptions, BatchSource


class FindPoses:
    """Find the poses of the photographs, if requested; resumes an interrupted search."""

    is_needed_later = True

    def is_done(self, run: ReconstructionRun) -> bool:
        """Return False: the search itself checks what exists."""
        return False

    def __call__(self, run: ReconstructionRun) -> None:
        """Find the poses; a new run says first which files it leaves out."""
        config = run.config
        if run.recorded is None:
            run.georeference = read_request(
                run.scene, config.georeference, config.control_points, config.known_length
            )
            for sentence in notes_on_files(run.scene):
                run.progress(Warned(sentence))
            if (notice := config.preset_notice()) is not None:
                run.progress(Noted(notice))
        find_missing_poses(
            scene=run.scene,
            output=run.output,
            config=run.config,
            threads=run.threads,
            progress=run.progress,
            should_stop=run.should_stop,
        )
        if run.recorded is None:
            tell_of_former_poses(run.output, run.progress)
            warn_of_other_models(run.output, run.progress)


class OpenDataset:
    """Open the photographs with their poses; those of a new run are repaired first."""

    is_needed_later = True

    def is_done(self, run: ReconstructionRun) -> bool:
        """Return False: each run opens its photographs, from a cache if it has one."""
        return False

    def __call__(self, run: ReconstructionRun) -> None:
        """Open the photographs, and record which they are."""
        output = run.output
        run.dataset = _load_dataset(run)
        if run.recorded is None:  # a run that goes on keeps the poses that it has trained with
            _repair_poses(run)
            if has_start(output):
                check_start(output, run.dataset, run.config.train, run.progress)
            _find_georeference(run)
            write_views(output / VIEWS, run.dataset.views_record)
        held_out = [run.dataset.views[i].name for i in run.dataset.test_indices]
        write_held_out(output / HELD_OUT, held_out)
        _note_folder(run)


@dataclass(frozen=True)
class OpenBlockPhotographs:
    """Open the photographs that one block of a planned run needs; all of them where that is not known.

    Attributes:
        number: of the block, from 1.
    """

    number: int
    is_needed_later = True

    def is_done(self, run: ReconstructionRun) -> bool:
        """Return False: each run opens its photographs, from a cache if it has one."""
        return False

    def __call__(self, run: ReconstructionRun) -> None:
        """Open the photographs."""
        known = read_block_photographs(run.output / BLOCKS)
        if known is None or run.recorded is None or self.number > len(known.views):  # a plan of old
            run_steps((FindPoses(), OpenDataset()), run)
            return
        with phase("load", run.progress):
            run.dataset = open_run_part(
                run.scene,
                run.output,
                run.config,
                run.threads,
                run.progress,
                known.views[self.number - 1],
                known.facts,
                check_views=run.check_views,
            )
        _note_folder(run)


def _note_folder(run: ReconstructionRun) -> None:
    """Write where the photographs are, if they have moved, and which files are wanted, if others are."""
    output = run.output
    if dataset_folder_of_run(output) != run.scene.resolve() or read_config(output / CONFIG) != run.config:
        rewrite_config(run)


def _repair_poses(run: ReconstructionRun) -> None:
    """Repair poses and lenses that contradict the photographs; reload the model if it changed."""
    if repair_run_poses(
        dataset=run.dataset,
        output=run.output,
        config=run.config,
        threads=run.threads,
        progress=run.progress,
        should_stop=run.should_stop,
    ):
        run.dataset = _load_dataset(run)
    if estimate_principal_points(run.dataset, run.output, run.config, run.progress, run.should_stop):
        run.dataset = _load_dataset(run)


def _find_georeference(run: ReconstructionRun) -> None:
    """Write where the scene of a new run lies, if that is known."""
    if run.georeference is None:
        return
    found = find_georeference(run.dataset, run.georeference, lambda text: run.progress(Noted(text)))
    if found is not None:
        write_georeference(run.output / GEOREFERENCE_FILE, found)


def _load_dataset(run: ReconstructionRun) -> Dataset:
    with phase("load", run.progress):
        dataset = open_run_dataset(
            run.scene,
            run.output,
            run.config,
            run.threads,
            run.progress,
            model_folder=found_model_folder(run.output),
            check_views=run.check_views,
        )
        options = BatchOptions.from_config(run.config.train, dataset)
        BatchSource(dataset, options)  # refuses settings that do not suit the photographs
    return dataset
