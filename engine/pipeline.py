"""The main job, from photographs to a measured scene and its meshes.

Each stage leaves its result on disk and is skipped when the result is there, so that a run that was stopped
or killed goes on where it was.

    load -> train (initialise, fit) -> scene.ply -> evaluate -> export
"""

import hashlib
import importlib.metadata
import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

import engine
from engine.config import ReconstructionConfig, read_config
from engine.errors import ConfigError, DamagedCheckpoint, DatasetError, OutputError
from engine.evaluate.held_out import evaluate_held_out
from engine.events import (
    JsonLinesListener,
    Listener,
    RunFinished,
    StageFinished,
    StageProgress,
    StageStarted,
    Warned,
    broadcast,
)
from engine.export.options import ExportOptions
from engine.export.registry import export_scene
from engine.files import write_json
from engine.gaussians.model import FlatGaussians
from engine.gaussians.ply import read_gaussian_ply, write_gaussian_ply
from engine.scene import Dataset, write_held_out
from engine.threads import use_threads
from engine.train.checkpoint import TrainState, latest_checkpoint, load_checkpoint
from engine.train.config import TrainConfig, iteration_count, most_gaussians
from engine.train.dense_points import dense_points
from engine.train.initialise import from_points, from_rays
from engine.train.trainer import Trainer, fresh_state

CONFIG, EVENTS, HELD_OUT, SCENE, TRAINING = (
    "config.json", "events.jsonl", "held_out.json", "scene.ply", "training.json",
)  # fmt: skip
CHECKPOINTS, CACHE = "checkpoints", "cache"
MIN_POINTS = 50
"""Fewer sparse points than this are no use to begin from; random ones are taken."""


def reconstruct(
    scene: Path,
    output: Path,
    config: ReconstructionConfig,
    *,
    resume: bool = False,
    threads: int = 0,
    listener: Listener = lambda _event: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Path:
    """Reconstruct ``scene`` into the folder ``output`` and return it.

    The folder then holds ``scene.ply``, the meshes, ``metrics.json``, ``report.html``, ``renders/``,
    ``checkpoints/``, ``config.json``, ``held_out.json`` and ``events.jsonl``.

    Args:
        scene: folder with photographs and a COLMAP model, see :meth:`engine.scene.Dataset.open`.
        output: a folder that does not exist, is empty, or holds the same run if ``resume``.
        config: all settings.
        resume: go on with the run that is in ``output``.
        threads: for everything; 0 means all cores.
        listener: hears the events that also go to ``events.jsonl``.
        should_stop: asked now and then; True stops the run after a checkpoint.

    Raises:
        DatasetError: the photographs or the model cannot be used.
        OutputError: ``output`` holds something else or cannot be written.
        ConfigError: with ``resume``, other settings than the run's.
        TrainingFailure: training collapsed.
        Cancelled: stopped as asked.
    """
    began = time.perf_counter()
    use_threads(threads)
    is_new = _claim_output(scene, output, config, resume)
    events = JsonLinesListener(output / EVENTS)
    tell = broadcast([events, listener])
    try:
        with _stage("load", tell):
            try:
                dataset = _open_dataset(scene, output, config, threads, tell)
            except DatasetError:
                if is_new:  # so that the corrected command finds the folder free
                    (output / CONFIG).unlink()
                    (output / EVENTS).unlink()
                raise
            write_held_out(output / HELD_OUT, [dataset.views[i].name for i in dataset.test_indices])
        if not (output / SCENE).exists():
            with _stage("train", tell, iteration_count(config.train, dataset.train_pixel_count)):
                gaussians = _train(dataset, output, config.train, threads, tell, should_stop)
                write_gaussian_ply(gaussians, output / SCENE, near_world=dataset.near_world)
        if not (output / "metrics.json").exists() or not (output / "report.html").exists():
            with _stage("evaluate", tell, len(dataset.test_indices)):
                _evaluate(dataset, output, config, threads, tell)
        with _stage("export", tell, len(config.exports)):
            _export(output, config, tell)
        dataset.release_pages()
        outputs = tuple(
            sorted(p.name for p in output.iterdir() if p.name != CACHE and not p.name.startswith("."))
        )
        tell(RunFinished(outputs, time.perf_counter() - began))
    finally:
        events.close()
    return output


def evaluate(
    output: Path, *, scene: Path | None = None, threads: int = 0, listener: Listener = lambda _event: None
) -> Path:
    """Measure the scene of a finished run again and write its metrics, renders and report anew.

    Args:
        output: folder of the run.
        scene: where the photographs are now; None takes the folder that the run was made from.
        threads: for everything; 0 means all cores.
        listener: hears the progress.

    Returns:
        The path of ``metrics.json``.

    Raises:
        ConfigError: ``output`` is no run.
        DatasetError: the photographs cannot be used.
    """
    use_threads(threads)
    config = read_config(output / CONFIG)
    if not (output / SCENE).exists():
        raise OutputError(
            f"{output} holds no {SCENE} yet; finish the run with: octasplat reconstruct --resume."
        )
    dataset = _open_dataset(scene or run_scene(output), output, config, threads, listener)
    with _stage("evaluate", listener, len(dataset.test_indices)):
        _evaluate(dataset, output, config, threads, listener)
    return output / "metrics.json"


def run_scene(output: Path) -> Path:
    """The scene folder that a run was made from.

    Raises:
        ConfigError: ``output`` is no run.
    """
    try:
        return Path(json.loads((output / CONFIG).read_text(encoding="utf-8"))["scene"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{output / CONFIG} cannot be read ({error}); name the folder of a run.") from None


def open_run_dataset(output: Path, *, scene: Path | None = None, threads: int = 0) -> Dataset:
    """The photographs of a run, as it used them."""
    return _open_dataset(
        scene or run_scene(output), output, read_config(output / CONFIG), threads, lambda _event: None
    )


def versions() -> dict[str, str]:
    """Versions of everything that can change a result."""
    names = ("embreex", "numba", "numpy", "scipy", "pycolmap", "OpenImageIO", "flip-evaluator")
    return {"octasplat": engine.__version__, **{name: importlib.metadata.version(name) for name in names}}


@contextmanager
def _stage(name: str, tell: Listener, steps: int = 0) -> Iterator[None]:
    tell(StageStarted(name, steps))
    began = time.perf_counter()
    yield
    tell(StageFinished(name, time.perf_counter() - began))


def _claim_output(scene: Path, output: Path, config: ReconstructionConfig, resume: bool) -> bool:
    """Create the folder and its ``config.json``, or make sure that it is the run to go on with.

    Returns:
        Whether the run is new.
    """
    content = {
        "scene": str(scene.resolve()),
        "reconstruction": config.model_dump(mode="json"),
        "versions": versions(),
    }
    if output.exists() and not output.is_dir():
        raise OutputError(f"{output} is a file; name a folder for the results.")
    if (output / CONFIG).exists():
        if not resume:
            raise OutputError(
                f"{output} already holds a run; add --resume to go on with it, or name another folder."
            )
        if read_config(output / CONFIG) != config:
            raise ConfigError(
                f"{output / CONFIG} has other settings than this command; repeat the settings of the run, "
                "or name another folder."
            )
        if run_scene(output) != scene.resolve():  # the photographs have moved
            write_json(output / CONFIG, content)
        return False
    if output.is_dir() and any(not path.name.startswith(".") for path in output.iterdir()):
        raise OutputError(f"{output} is not empty and holds no run; name an empty or a new folder.")
    try:
        output.mkdir(parents=True, exist_ok=True)
        for left in output.glob(".*.partial.*"):  # by a run that was killed while it wrote
            left.unlink()
        write_json(output / CONFIG, content)
    except OSError as error:
        raise OutputError(
            f"{output} cannot be written to ({error.strerror or error}); name another folder."
        ) from None
    return True


def _open_dataset(
    scene: Path, output: Path, config: ReconstructionConfig, threads: int, tell: Listener
) -> Dataset:
    dataset = Dataset.open(
        scene,
        output / CACHE,
        max_side=config.max_side,
        test_every=config.test_every,
        held_out=config.held_out,
        masks=config.masks,
        near=config.train.near,
        threads=threads,
        progress=lambda done, total: tell(StageProgress("load", done, total)),
    )
    for warning in dataset.warnings:
        tell(Warned(warning))
    return dataset


def _fingerprint(dataset: Dataset, config: TrainConfig) -> str:
    """Names the settings and the photographs that a checkpoint belongs to."""
    views = [(v.name, v.width_px, v.height_px, v.origin_world.tolist()) for v in dataset.views]
    text = json.dumps([config.model_dump(mode="json"), views, dataset.train_indices.tolist()])
    return hashlib.sha256(text.encode()).hexdigest()


def _train(
    dataset: Dataset,
    output: Path,
    config: TrainConfig,
    threads: int,
    tell: Listener,
    should_stop: Callable[[], bool],
) -> FlatGaussians:
    folder = output / CHECKPOINTS
    fingerprint = _fingerprint(dataset, config)
    state = _resume(folder, fingerprint, tell)
    if state is None:
        first = initial_gaussians(dataset, config, threads=use_threads(threads))
        state = fresh_state(first, config.seed)
    trainer = Trainer(
        dataset,
        config,
        state,
        folder=folder,
        fingerprint=fingerprint,
        listener=tell,
        threads=threads,
        should_stop=should_stop,
    )
    gaussians = trainer.run()
    write_json(output / TRAINING, {"seconds": trainer.state.seconds, "iterations": trainer.state.iteration})
    return gaussians


def _resume(folder: Path, fingerprint: str, tell: Listener) -> TrainState | None:
    """The newest checkpoint; a damaged one is passed over for the one before."""
    while (path := latest_checkpoint(folder)) is not None:
        try:
            return load_checkpoint(path, fingerprint)
        except DamagedCheckpoint as error:
            tell(Warned(str(error)))
            path.unlink()
    return None


def initial_gaussians(dataset: Dataset, config: TrainConfig, *, threads: int = 1) -> FlatGaussians:
    """The first Gaussians: on the sparse points, or on random rays where there are too few of them."""
    rng = np.random.Generator(np.random.PCG64([config.seed, 2]))
    points = dataset.points
    limit = min(config.initial_points, most_gaussians(config, dataset.train_pixel_count))
    if len(points.xyz_world) >= MIN_POINTS:
        centres = np.stack([dataset.views[i].origin_world for i in dataset.train_indices])
        xyz, rgb = points.xyz_world, points.rgb_srgb
        if config.lift_pixels and len(xyz) < limit:
            more_xyz, more_rgb = dense_points(dataset, limit - len(xyz), rng, threads=threads)
            xyz, rgb = np.concatenate([xyz, more_xyz]), np.concatenate([rgb, more_rgb])
        return from_points(
            xyz,
            rgb,
            centres,
            extent=dataset.extent,
            limit=limit,
            opacity=config.initial_opacity,
            rng=rng,
        )
    view, y, x = dataset.sample_pixels(rng, limit)
    rays = dataset.rays(view, y, x)
    rgb, alpha, weight = dataset.pixels(view, y, x)
    seen = (weight > 0) & (alpha > 0)
    return from_rays(
        rays.origins_world[seen],
        rays.directions_world[seen],
        rgb[seen],
        extent=dataset.extent,
        opacity=config.initial_opacity,
        rng=rng,
    )


def _evaluate(
    dataset: Dataset, output: Path, config: ReconstructionConfig, threads: int, tell: Listener
) -> None:
    gaussians, _ = read_gaussian_ply(output / SCENE)
    training = json.loads((output / TRAINING).read_text(encoding="utf-8"))
    evaluate_held_out(
        dataset,
        gaussians,
        output,
        settings=config.train.trace,
        background=config.evaluate_background,
        run={
            "gaussians": len(gaussians),
            "iterations": training["iterations"],
            "seconds": training["seconds"],
            "seed": config.train.seed,
            "resolution": {"max_side": config.max_side},
            "background": config.evaluate_background,
            "versions": versions(),
        },
        config=json.loads((output / CONFIG).read_text(encoding="utf-8")),
        threads=threads,
        tell=tell,
    )


def _export(output: Path, config: ReconstructionConfig, tell: Listener) -> None:
    missing = [name for name in config.exports if not (output / name).exists()]
    if not missing:
        return
    gaussians, _ = read_gaussian_ply(output / SCENE)
    options = ExportOptions(q=config.train.trace.q)
    for done, name in enumerate(missing, start=1):
        export_scene(gaussians, output / name, options)
        tell(StageProgress("export", done, len(missing)))
