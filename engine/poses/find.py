"""Structure from motion on a folder of photographs."""

import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import pycolmap
from pydantic import BaseModel, ConfigDict, Field

from engine.errors import Cancelled, DatasetError
from engine.events import Listener, StageFinished, StageProgress, StageStarted, Warned, ignore
from engine.poses.database import feature_counts, pairs_matched
from engine.scene.images import read_image_info

T = TypeVar("T")

FEATURES, MATCHES, STAGE = "features", "matches", "poses"
MODEL = Path("sparse") / "0"
MIN_PHOTOGRAPHS = 3
SMALL_PX = 480
"""Below this, what COLMAP finds was seen to be wrong without any sign of it."""
_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp"})
_LOOK_SECONDS = 0.5
_SIGN_SECONDS = 30.0
"""How often a step that takes long tells that it is alive."""


class PosesConfig(BaseModel):
    """How poses are found.

    Attributes:
        max_image_side_px: features are looked for at most at this size.
        max_features: of a photograph.
        exhaustive_up_to: up to so many photographs every pair is matched; above, each with its neighbours by
            name, near and far.
        overlap: neighbours on one side, doubling in distance.
        min_share: of the photographs that must get a pose.
        max_reprojection_px: mean error above which the result is not trusted.
        min_points: sparse points below which it is not either.
        seed: of everything random.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_image_side_px: int = Field(1600, ge=64)
    max_features: int = Field(4096, ge=256)
    exhaustive_up_to: int = Field(150, ge=2)
    overlap: int = Field(15, ge=2)
    min_share: float = Field(0.5, gt=0, le=1)
    max_reprojection_px: float = Field(2.5, gt=0)
    min_points: int = Field(100, ge=10)
    seed: int = Field(0, ge=0)


DEFAULT_CONFIG = PosesConfig()


def find_poses(
    images: Path,
    output: Path,
    *,
    config: PosesConfig = DEFAULT_CONFIG,
    threads: int = 0,
    listener: Listener = ignore,
    should_stop: Callable[[], bool] = lambda: False,
) -> Path:
    """Find where photographs were taken, and a sparse point cloud.

    There are three stages: ``features``, whose steps are photographs, ``matches``, whose steps are pairs of
    them, and ``poses``, whose steps are photographs again. A result that is there already is taken as it is.

    Args:
        images: folder of photographs, also in folders below it.
        output: receives ``sparse/0``; what is needed on the way lies in ``work`` beside it and is removed.
        config: settings.
        threads: to use; 0 means all cores.
        listener: hears the progress.
        should_stop: asked now and then; True gives up.

    Returns:
        The folder of the COLMAP model.

    Raises:
        DatasetError: too few photographs, or they do not fit together; the text says what to do.
        Cancelled: stopped as asked.
    """
    model = output / MODEL
    if model.is_dir():
        return model
    names = photographs_in(images)
    work = output / "work"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    try:
        run = _Run(images, names, work, config, threads or -1, listener, should_stop)
        run.extract()
        run.match()
        with _stage(STAGE, len(names), listener):
            best = run.map()
            _check(best, len(names), config, listener)
            found = work / "found"
            found.mkdir()
            best.write_binary(str(found))
            model.parent.mkdir(parents=True, exist_ok=True)
            found.rename(model)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return model


@contextmanager
def _stage(name: str, steps: int, listener: Listener) -> Iterator[None]:
    began = time.monotonic()
    listener(StageStarted(name, steps))
    yield
    listener(StageProgress(name, steps, steps))
    listener(StageFinished(name, time.monotonic() - began))


def photographs_in(folder: Path) -> list[str]:
    """Names of the photographs that poses can be found for, relative to ``folder``.

    Raises:
        DatasetError: there are fewer than three.
    """
    names = sorted(
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.suffix.lower() in _SUFFIXES and path.is_file() and not path.name.startswith(".")
    )
    if len(names) < MIN_PHOTOGRAPHS:
        raise DatasetError(
            f"{folder} holds {len(names)} photographs that poses can be found for (JPEG, PNG, TIFF, BMP); "
            f"at least {MIN_PHOTOGRAPHS} are needed."
        )
    return names


class _Run:
    """COLMAP at work in a thread, watched by this one."""

    def __init__(
        self,
        images: Path,
        names: list[str],
        work: Path,
        config: PosesConfig,
        threads: int,
        listener: Listener,
        should_stop: Callable[[], bool],
    ) -> None:
        self._images = images
        self._names = names
        self._work = work
        self._database = work / "database.db"
        self._config = config
        self._threads = threads
        self._listener = listener
        self._should_stop = should_stop
        self._registered = 0
        pycolmap.logging.minloglevel = 2  # its warnings are of use to nobody here
        pycolmap.set_random_seed(config.seed)

    def extract(self) -> None:
        """Features of every photograph."""
        options = pycolmap.FeatureExtractionOptions()
        options.num_threads = self._threads
        options.max_image_size = self._config.max_image_side_px
        options.use_gpu = False
        options.sift.max_num_features = self._config.max_features
        # One size means one lens as a rule, and a lens shared by all is found far more surely.
        sizes = {
            (info.width_px, info.height_px)
            for info in (read_image_info(self._images / name) for name in self._names)
        }
        longest = max(max(info) for info in sizes)
        if longest < SMALL_PX:
            self._listener(
                Warned(
                    f"The photographs are {longest} px long at most; poses found from such small ones may be "
                    "wrong, so give them at full size."
                )
            )
        mode = pycolmap.CameraMode.SINGLE if len(sizes) == 1 else pycolmap.CameraMode.AUTO
        count = len(self._names)
        with _stage(FEATURES, count, self._listener):
            self._watched(
                lambda token: pycolmap.extract_features(
                    self._database,
                    self._images,
                    image_names=self._names,
                    camera_mode=mode,
                    extraction_options=options,
                    device=pycolmap.Device.cpu,
                    cancellation_token=token,
                ),
                lambda: StageProgress(FEATURES, len(feature_counts(self._database)), count),
            )
        poor = [name for name, count in feature_counts(self._database).items() if count < 50]
        if poor:
            self._listener(
                Warned(f"{len(poor)} photographs show little that can be recognised ({', '.join(poor[:3])}).")
            )

    def match(self) -> None:
        """Matches between photographs."""
        count, config = len(self._names), self._config
        options = pycolmap.FeatureMatchingOptions()
        options.num_threads = self._threads
        options.use_gpu = False
        exhaustive = count <= config.exhaustive_up_to
        # Far neighbours that do not exist make the second number a little too high.
        pairs = count * (count - 1) // 2 if exhaustive else 2 * count * config.overlap
        if not exhaustive:
            self._listener(
                Warned(
                    f"There are more than {config.exhaustive_up_to} photographs, so each is matched with its "
                    "neighbours by name only; name them in the order in which they were taken."
                )
            )

        def run(token: Any) -> None:
            if exhaustive:
                pycolmap.match_exhaustive(
                    self._database,
                    matching_options=options,
                    device=pycolmap.Device.cpu,
                    cancellation_token=token,
                )
                return
            pairing = pycolmap.SequentialPairingOptions()
            pairing.overlap = config.overlap
            pairing.quadratic_overlap = True
            pairing.loop_detection = False
            pycolmap.match_sequential(
                self._database,
                matching_options=options,
                pairing_options=pairing,
                device=pycolmap.Device.cpu,
                cancellation_token=token,
            )

        with _stage(MATCHES, pairs, self._listener):
            self._watched(
                run, lambda: StageProgress(MATCHES, min(pairs, pairs_matched(self._database)), pairs)
            )

    def map(self) -> Any:
        """The model with the most photographs.

        Raises:
            DatasetError: there is none.
        """
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads = self._threads
        options.random_seed = self._config.seed
        options.ba_use_gpu = False
        options.min_model_size = MIN_PHOTOGRAPHS
        options.extract_colors = True

        def registered() -> None:
            self._registered += 1

        models: dict[int, Any] = self._watched(
            lambda token: pycolmap.incremental_mapping(
                self._database,
                self._images,
                self._work / "models",
                options=options,
                next_image_callback=registered,
                cancellation_token=token,
            ),
            lambda: StageProgress(STAGE, min(self._registered, len(self._names)), len(self._names)),
        )
        if not models:
            raise DatasetError(
                "No poses were found: the photographs do not overlap enough, or are blurred or plain; "
                "take more of them from nearby places, or send a COLMAP model."
            )
        return max(models.values(), key=lambda model: model.num_reg_images())

    def _watched(self, run: Callable[[Any], T], progress: Callable[[], StageProgress]) -> T:
        """Run in a thread; tell of the progress and hear of the wish to stop meanwhile.

        Raises:
            Cancelled: stopped as asked.
            DatasetError: COLMAP gave up.
        """
        token = pycolmap.CancellationToken()
        outcome: dict[str, Any] = {}

        def inside() -> None:
            try:
                outcome["value"] = run(token)
            except Exception as error:  # noqa: BLE001 - told below
                outcome["error"] = error

        thread = threading.Thread(target=inside, daemon=True)
        thread.start()
        last, told = None, 0.0
        while thread.is_alive():
            thread.join(_LOOK_SECONDS)
            if self._should_stop():
                token.cancel()
            now = progress()
            if now != last or time.monotonic() - told > _SIGN_SECONDS:
                last, told = now, time.monotonic()
                self._listener(now)
        if self._should_stop():
            raise Cancelled("Stopped while finding poses; the same command begins them again.")
        if "error" in outcome:
            raise DatasetError(
                f"COLMAP cannot find poses for {self._images} ({outcome['error']}); look at the photographs."
            ) from None
        value: T = outcome["value"]
        return value


def _check(model: Any, count: int, config: PosesConfig, listener: Listener) -> None:
    """Refuse a result that would only waste the training.

    Raises:
        DatasetError: too few photographs have poses, or these do not fit.
    """
    posed = model.num_reg_images()
    advice = "take more photographs with more overlap, of things that stand still, or send a COLMAP model."
    if posed < max(MIN_PHOTOGRAPHS, config.min_share * count):
        raise DatasetError(f"Only {posed} of {count} photographs could be placed; {advice}")
    error_px = float(model.compute_mean_reprojection_error())
    points = model.num_points3D()
    if points < config.min_points or not error_px <= config.max_reprojection_px:
        raise DatasetError(
            f"The poses are not to be trusted ({points} points, {error_px:.1f} px mean error); {advice}"
        )
    if posed < count:
        listener(Warned(f"{count - posed} of {count} photographs could not be placed and are left out."))
