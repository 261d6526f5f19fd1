"""The search for poses, from photographs to a model that can be trusted; runs in a process of its own."""

import sqlite3
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.events import CheckpointWritten, EventListener, PhaseProgress, Warned
from octasplat.engine.core.progress import phase
from octasplat.engine.core.scene_layout import MIN_PHOTOGRAPHS
from octasplat.engine.core.writing import write_json
from octasplat.engine.poses.config import (
    FEATURES,
    MAPPING_STAGE,
    MATCHES,
    READING,
    RECORD_FILE,
    RETRY_BELOW_SHARE,
    PosesConfig,
)
from octasplat.engine.poses.disambiguation import (
    MappedModels,
    disambiguate,
    leave_out_pairs_before_mapping,
)
from octasplat.engine.poses.features import (
    create_database,
    extract_features,
    feature_counts,
    match_pairs,
    photographs_of,
    preselect_pairs,
)
from octasplat.engine.poses.found_models import write_other_models
from octasplat.engine.poses.gps_contradictions import read_ground_positions
from octasplat.engine.poses.incremental_mapping import (
    FROM_THE_BEGINNING,
    Continuation,
    best_rank,
    map_in_segments,
    map_photographs,
)
from octasplat.engine.poses.model_selection import distinct_models, model_facts
from octasplat.engine.poses.pairs import Pair, all_pairs, pair_count
from octasplat.engine.poses.photograph_check import (
    check_photographs_decode,
    read_image_infos,
    warn_of_small_photographs,
)
from octasplat.engine.poses.remaining_photographs import MatchedCapture, register_remaining
from octasplat.engine.poses.search_check import check_mapped, search_rank
from octasplat.engine.poses.stored_mappings import (
    MAPPINGS_FOLDER,
    StoredMapping,
    adopt_stored_mappings,
    matches_digest,
    store_mappings,
)
from octasplat.engine.poses.stored_search import (
    DATABASE,
    SearchKeeper,
    adopt_stored_database,
    read_pairs,
    store_database,
    write_pairs,
)
from octasplat.engine.poses.whole_files import copy_database, write_model
from octasplat.engine.poses.workspace import link_photographs, progress_stage

_FEW_FEATURES = 50


class PoseSearch:
    """A search in a folder of its own.

    Args:
        images: folder of the photographs.
        names: of the photographs in it.
        work: an empty folder, or the one in which the same search was stopped.
        config: settings.
        threads: to use; 0 means all cores.
        progress: hears the progress.
    """

    def __init__(
        self,
        images: Path,
        names: Sequence[str],
        work: Path,
        config: PosesConfig,
        threads: int,
        progress: EventListener,
    ) -> None:
        self._images = images
        self._all_names = tuple(names)
        self._infos = read_image_infos(images, names)
        self._names = tuple(self._infos)
        self._work = work
        self._config = config
        self._threads = threads or -1
        self._progress = progress
        adopt_stored_database(work)
        adopt_stored_mappings(work)
        self._mappings = 0
        self._photographs = work / "photographs"
        self._aliases = link_photographs(images, self._names, self._photographs, progress)
        pycolmap.logging.minloglevel = 2  # its warnings are of use to nobody here
        self._drop_unreadable()
        self._one_camera = self._has_one_size()
        warn_of_small_photographs([self._infos[name] for name in self._names], progress)

    def run(self, found: Path) -> None:
        """Search, a second time if photographs are left out, and write the best model.

        Args:
            found: folder to make for the model, and for what is to be said of it as JSON.

        Raises:
            DatasetError: too few photographs have poses, or these do not fit.
        """
        count, config = len(self._names), self._config
        mapped = self._search(thorough=False)
        placed = mapped.placed(count)
        if placed < count and (count <= config.exhaustive_up_to or placed < RETRY_BELOW_SHARE * count):
            self._progress(
                Warned(
                    f"{placed} of {count} photographs could be placed at first; they are searched again with "
                    "more features."
                )
            )
            # max keeps the first of equals: the usual search
            mapped = max(
                mapped,
                self._search(thorough=True),
                key=lambda each: search_rank(each, count, config.min_share),
            )
        models = mapped.models
        names = dict(zip(self._aliases, self._names, strict=True))
        check_mapped(mapped, names, config.min_share, self._progress)
        found.mkdir(exist_ok=True)
        for number, model in enumerate(distinct_models(models)):
            # One after the other: colors are sums.
            model.extract_colors_for_all_images(self._photographs, num_threads=1)
            for image in model.images.values():
                image.name = names[image.name]
            folder = found / str(number) if number else found
            write_model(model, folder)
            write_json(folder / RECORD_FILE, model_facts(model, self._all_names))
        write_other_models(found)

    def _search(self, *, thorough: bool) -> MappedModels:
        """Return the models that the photographs come to, that of most photographs first."""
        database = self._work / ("thorough.db" if thorough else DATABASE)
        self._find_features(database, thorough)
        matched = self._match(database, thorough)
        count = len(self._names)
        # Mapping adds and removes matches: a search that is stopped in it goes on from what was matched.
        database = copy_database(database, self._work / "mapping.db")
        with progress_stage(MAPPING_STAGE, count, self._progress) as at:
            ground_m = read_ground_positions(database)
            # what is large takes too long to be mapped a second time
            if self._config.is_large(count) and (
                removed := leave_out_pairs_before_mapping(database, ground_m, self._config.seed)
            ):
                self._progress(Warned(f"{removed} pairs of photographs that contradict GPS were left out."))
            mapped = disambiguate(
                self._map(database, at), database, ground_m, lambda copy: self._map(copy, at)
            )
            if best_rank(mapped.models)[0] < count:
                mapped = register_remaining(
                    MatchedCapture(
                        database,
                        self._aliases,
                        matched,
                        ground_m,
                        self._config,
                        lambda copy, continuation: self._map(copy, at, continuation),
                        self._threads,
                    ),
                    mapped,
                )
            at(mapped.placed(count))
        return mapped

    def _find_features(self, database: Path, thorough: bool) -> None:
        count = len(self._names)
        with progress_stage(FEATURES, count, self._progress) as at:
            if not database.exists():
                new = database.with_suffix(".new")
                new.unlink(missing_ok=True)
                create_database(new, self._photographs, self._aliases, one_camera=self._one_camera)
                new.rename(database)
            keeper = SearchKeeper(database, count, self._progress)

            def tell(done: int) -> None:
                at(done)
                keeper.keep_at_times(done)

            extract_features(
                database,
                self._photographs,
                self._aliases,
                self._config,
                thorough=thorough,
                one_camera=self._one_camera,
                threads=self._threads,
                on_count=tell,
            )
            keeper.keep(count)
        counts = feature_counts(database, count)
        poor = [name for name, found in zip(self._names, counts, strict=True) if found < _FEW_FEATURES]
        if poor:
            self._progress(
                Warned(f"{len(poor)} photographs show little that can be recognised ({', '.join(poor[:3])}).")
            )

    def _match(self, database: Path, thorough: bool) -> list[Pair]:
        config, count = self._config, len(self._names)
        total, look_share = pair_count(count), config.quick_look_work_share(count)

        def tell(settled: int, work_done: float) -> None:
            self._progress(PhaseProgress(MATCHES, settled, total, work_done=work_done))

        keeper = SearchKeeper(database, count, self._progress)
        with phase(MATCHES, self._progress, total):
            if not look_share:
                pairs = all_pairs(count)
            elif (known := read_pairs(database)) is not None:
                pairs = known
            else:
                pairs = preselect_pairs(
                    database,
                    self._aliases,
                    config,
                    threads=self._threads,
                    on_look=lambda unlike, looked: tell(unlike, look_share * looked),
                )
                write_pairs(database, pairs)
            unlike, wanted = total - len(pairs), max(len(pairs), 1)

            def tell_matched(done: int) -> None:
                tell(unlike + done, look_share + (1 - look_share) * done / wanted)
                keeper.keep_at_times(unlike + done)

            match_pairs(
                database,
                self._aliases,
                pairs,
                config,
                thorough=thorough,
                threads=self._threads,
                on_count=tell_matched,
            )
            keeper.keep(total, is_final=True)
        return pairs

    def _map(
        self,
        database: Path,
        at: Callable[[int], None],
        continuation: Continuation = FROM_THE_BEGINNING,
    ) -> list[Any]:
        seed = self._config.seed
        if not self._config.is_large(len(self._names)):
            return map_photographs(
                database,
                seed=seed,
                on_count=at,
                allow_weak_links=continuation.allow_weak_links,
                start=continuation.start,
            )
        # A search that goes on maps the same matches in the same order.
        folder = self._work / MAPPINGS_FOLDER / str(self._mappings)
        self._mappings += 1
        return map_in_segments(
            database,
            StoredMapping(folder, matches_digest(database), self._tell_stored_mapping),
            seed=seed,
            on_count=at,
            continuation=continuation,
        )

    def _tell_stored_mapping(self, placed: int) -> None:
        with suppress(OSError, sqlite3.Error):  # for other hosts; the states themselves are in the folder
            store_database(self._work)
            self._progress(CheckpointWritten(placed, str(store_mappings(self._work))))

    def _drop_unreadable(self) -> None:
        """Leave out photographs that COLMAP does not read, and warn of all that nobody could read.

        COLMAP gives their numbers to those that follow, so that what is left out has to be known before
        photographs are numbered.

        Raises:
            DatasetError: too few are left.
        """
        database = self._work / DATABASE
        if database.exists():  # of a search that was stopped
            read = set(photographs_of(database))
        else:
            # made under another name, so that a database that is there is whole
            trial = database.with_suffix(".new")
            trial.unlink(missing_ok=True)
            read = self._read_photographs(trial)
            if len(read) == len(self._aliases):
                trial.rename(database)  # COLMAP decodes every photograph for it: do so once
        kept = [k for k, alias in enumerate(self._aliases) if alias in read]
        self._names = tuple(self._names[k] for k in kept)
        self._aliases = tuple(self._aliases[k] for k in kept)
        unread = [name for name in self._all_names if name not in set(self._names)]
        if unread:
            self._progress(
                Warned(
                    f"{len(unread)} of {len(self._all_names)} photographs cannot be read and are left out "
                    f"({', '.join(unread[:3])}{', ...' if len(unread) > 3 else ''}); replace these files."
                )
            )
        if len(self._names) < MIN_PHOTOGRAPHS:
            raise DatasetError(
                f"Only {len(self._names)} of {len(self._all_names)} photographs can be read; at least "
                f"{MIN_PHOTOGRAPHS} are needed."
            )

    def _read_photographs(self, database: Path) -> set[str]:
        """Read each photograph to its end, and once more by COLMAP; returns those that COLMAP can read.

        Raises:
            DatasetError: a photograph is cut short.
        """
        count = len(self._aliases)
        with progress_stage(READING, count, self._progress) as at:
            check_photographs_decode(
                self._images, self._names, threads=max(self._threads, 0), on_count=lambda done: at(done // 2)
            )
            return set(
                create_database(
                    database,
                    self._photographs,
                    self._aliases,
                    one_camera=self._has_one_size(),
                    on_count=lambda done: at(count // 2 + done - done // 2),
                )
            )

    def _has_one_size(self) -> bool:
        """Return whether all photographs have one size.

        That means one lens as a rule, and a lens shared by all is found far more surely.
        """
        infos = map(self._infos.__getitem__, self._names)
        return len({(info.width_px, info.height_px) for info in infos}) == 1
