"""The search for poses, from photographs to a model that can be trusted; runs in a process of its own."""

import contextlib
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pycolmap

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.events import EventListener, Warned
from octasplat.engine.core.scene_layout import MIN_PHOTOGRAPHS
from octasplat.engine.core.writing import write_json
from octasplat.engine.dataset.image_info import ImageInfo
from octasplat.engine.dataset.images import read_image_info
from octasplat.engine.poses.ambiguous_structure import count_pair_inliers, find_false_pairs, remove_pairs
from octasplat.engine.poses.config import (
    FEATURES,
    MAPPING_STAGE,
    MATCHES,
    MAX_REPROJECTION_PX,
    MIN_POINTS,
    PROPOSALS_PER_PHOTOGRAPH,
    READING,
    RECORD_FILE,
    RETRY_BELOW_SHARE,
    PosesConfig,
)
from octasplat.engine.poses.features import (
    create_database,
    extract_features,
    feature_counts,
    match_pairs,
    photographs_of,
    preselect_pairs,
)
from octasplat.engine.poses.incremental_mapping import map_photographs, model_rank
from octasplat.engine.poses.pairs import Pair, all_pairs, pair_count, pairs_with
from octasplat.engine.poses.photograph_check import check_photographs_decode
from octasplat.engine.poses.workspace import link_photographs, progress_stage

DATABASE = "database.db"
"""Of the first search, in the folder for the work."""
MIN_RECOMMENDED_SIDE_PX = 480
"""Below this, what COLMAP finds was seen to be wrong without any sign of it."""
_FEW_FEATURES = 50
_MAX_DISAMBIGUATIONS = 3


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
        self._infos = _read_image_infos(images, names)
        self._names = tuple(self._infos)
        self._work = work
        self._config = config
        self._threads = threads or -1
        self._progress = progress
        self._photographs = work / "photographs"
        self._aliases = link_photographs(images, self._names, self._photographs)
        pycolmap.logging.minloglevel = 2  # its warnings are of use to nobody here
        self._drop_unreadable()
        self._one_camera = self._has_one_size()
        self._warn_of_small_photographs()

    def run(self, found: Path) -> None:
        """Search, a second time if photographs are left out, and write the best model.

        Args:
            found: folder to make for the model, and for what is to be said of it as JSON.

        Raises:
            DatasetError: too few photographs have poses, or these do not fit.
        """
        count, config = len(self._names), self._config
        best = self._search(thorough=False)
        placed = model_rank(best)[0]
        if placed < count and (count <= config.exhaustive_up_to or placed < RETRY_BELOW_SHARE * count):
            self._progress(
                Warned(
                    f"{placed} of {count} photographs could be placed at first; they are searched again with "
                    "more features."
                )
            )
            # max keeps the first of equals: the usual search
            best = max(best, self._search(thorough=True), key=model_rank)
        self._check_model(best)
        # One after the other: colors are sums.
        best.extract_colors_for_all_images(self._photographs, num_threads=1)
        names = dict(zip(self._aliases, self._names, strict=True))
        for image in best.images.values():
            image.name = names[image.name]
        found.mkdir(exist_ok=True)
        best.write_binary(found)
        posed = {best.image(number).name for number in best.reg_image_ids()}
        write_json(
            found / RECORD_FILE,
            {
                "photographs": len(self._all_names),
                "placed": len(posed),
                "left_out": [name for name in self._all_names if name not in posed],
                "points": best.num_points3D(),
                "mean_reprojection_px": round(float(best.compute_mean_reprojection_error()), 4),
            },
        )

    def _search(self, *, thorough: bool) -> Any:
        database = self._work / ("thorough.db" if thorough else DATABASE)
        self._find_features(database, thorough)
        matched = self._match(database, thorough)
        count = len(self._names)
        # Mapping adds and removes matches: a search that is stopped in it goes on from what was matched.
        database = Path(shutil.copyfile(database, self._work / "mapping.db"))
        with progress_stage(MAPPING_STAGE, count, self._progress) as at:
            best = self._disambiguate(
                database,
                self._map(database, at),
                at,
            )
            if model_rank(best)[0] < count:
                best = self._register_remaining(database, best, matched, at)
            at(model_rank(best)[0])
        return best

    def _find_features(self, database: Path, thorough: bool) -> None:
        with progress_stage(FEATURES, len(self._names), self._progress) as at:
            if not database.exists():
                new = database.with_suffix(".new")
                new.unlink(missing_ok=True)
                create_database(new, self._photographs, self._aliases, one_camera=self._one_camera)
                new.rename(database)
            extract_features(
                database,
                self._photographs,
                self._aliases,
                self._config,
                thorough=thorough,
                one_camera=self._one_camera,
                threads=self._threads,
                on_count=at,
            )
        counts = feature_counts(database, len(self._names))
        poor = [name for name, found in zip(self._names, counts, strict=True) if found < _FEW_FEATURES]
        if poor:
            self._progress(
                Warned(f"{len(poor)} photographs show little that can be recognised ({', '.join(poor[:3])}).")
            )

    def _match(self, database: Path, thorough: bool) -> list[Pair]:
        count = len(self._names)
        total = pair_count(count)
        with progress_stage(MATCHES, total, self._progress) as at:
            if count > self._config.exhaustive_up_to:
                pairs = preselect_pairs(
                    database, self._aliases, self._config, threads=self._threads, on_count=at
                )
            else:
                pairs = all_pairs(count)
            unlike = total - len(pairs)
            match_pairs(
                database,
                self._aliases,
                pairs,
                self._config,
                thorough=thorough,
                threads=self._threads,
                on_count=lambda done: at(unlike + done),
            )
        return pairs

    def _disambiguate(self, database: Path, model: Any, at: Callable[[int], None]) -> Any:
        """Return the model rebuilt without the false matches of its folds, repeated while it has any."""
        for _ in range(_MAX_DISAMBIGUATIONS):
            if model is None:
                break
            votes = count_pair_inliers(model, database)
            false = find_false_pairs(votes)
            if len(false) == 0:
                break
            # on a copy: the false pairs come back if the trial is no better
            trial = database.with_name("trial.db")
            shutil.copyfile(database, trial)
            remove_pairs(trial, false)
            again = self._map(trial, at)
            if model_rank(again)[0] < model_rank(model)[0]:
                break
            # fewer matches explained: the cut was no fold
            if count_pair_inliers(again, trial).inliers.sum() <= votes.inliers.sum():
                break
            trial.replace(database)
            model = again
        return model

    def _register_remaining(
        self, database: Path, best: Any, matched: list[Pair], at: Callable[[int], None]
    ) -> Any:
        """Register photographs that were left out, with fewer matches required.

        They are matched with all others, in a large capture with those that are near by name.
        """
        posed = set() if best is None else {number - 1 for number in best.reg_image_ids()}
        count = len(self._names)
        rest = [k for k in range(count) if k not in posed]
        is_large = self._config.is_large(count)
        more = pairs_with(rest, count, matched, within=PROPOSALS_PER_PHOTOGRAPH if is_large else None)
        if more:
            match_pairs(
                database,
                self._aliases,
                more,
                self._config,
                thorough=True,
                threads=self._threads,
                on_count=lambda _done: None,
            )
        start = None
        if best is not None:
            start = self._work / "start"
            start.mkdir(exist_ok=True)
            best.write_binary(start)
        again = self._map(database, at, allow_weak_links=True, start=start)
        return max(best, again, key=model_rank)

    def _map(
        self,
        database: Path,
        at: Callable[[int], None],
        *,
        allow_weak_links: bool = False,
        start: Path | None = None,
    ) -> Any:
        return map_photographs(
            database,
            self._photographs,
            seed=self._config.seed,
            on_count=at,
            is_large=self._config.is_large(len(self._names)),
            allow_weak_links=allow_weak_links,
            start=start,
        )

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
        infos = [self._infos[name] for name in self._names]
        return len({(info.width_px, info.height_px) for info in infos}) == 1

    def _warn_of_small_photographs(self) -> None:
        infos = [self._infos[name] for name in self._names]
        longest = max(max(info.width_px, info.height_px) for info in infos)
        if longest < MIN_RECOMMENDED_SIDE_PX:
            self._progress(
                Warned(
                    f"The photographs are {longest} px long at most; poses found from such small ones may be "
                    "wrong, so give them at full size."
                )
            )

    def _check_model(self, best: Any) -> None:
        """Refuse a result that would only waste the training."""
        count, config = len(self._names), self._config
        if best is None:
            raise DatasetError(
                "No poses were found: the photographs do not overlap enough, or are blurred or plain; "
                "take more of them from nearby places, or send a COLMAP model."
            )
        posed, points = model_rank(best)
        advice = (
            "take more photographs with more overlap, of things that stand still, or send a COLMAP model."
        )
        if posed < max(MIN_PHOTOGRAPHS, config.min_share * count):
            raise DatasetError(f"Only {posed} of {count} photographs could be placed; {advice}")
        error_px = float(best.compute_mean_reprojection_error())
        if points < MIN_POINTS or not error_px <= MAX_REPROJECTION_PX:
            raise DatasetError(
                f"The poses are not to be trusted ({points} points, {error_px:.1f} px mean error); {advice}"
            )
        if posed < count:
            self._progress(
                Warned(f"{count - posed} of {count} photographs could not be placed and are left out.")
            )


def _read_image_infos(images: Path, names: Sequence[str]) -> dict[str, ImageInfo]:
    """Return what the headers of photographs say, for those that can be read."""
    found: dict[str, ImageInfo] = {}
    for name in names:
        with contextlib.suppress(DatasetError):
            found[name] = read_image_info(images / name)
    return found
