"""Renders the held-out views, measures them, and writes their pictures, ``metrics.json`` and the report."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.color import composite_over
from octasplat.engine.core.events import EventListener, PhaseProgress, Warned, read_events
from octasplat.engine.core.read_ahead import read_ahead
from octasplat.engine.core.threads import threads_in_use
from octasplat.engine.core.writing import write_json
from octasplat.engine.dataset import Dataset
from octasplat.engine.evaluate.advice import ViewFacts, advise, common_structure, fine_detail, support_groups
from octasplat.engine.evaluate.gallery import ViewImages, WorstAndBestViews
from octasplat.engine.evaluate.ground_truth import GroundTruth
from octasplat.engine.evaluate.ground_truth_measures import GroundTruthMeasures
from octasplat.engine.evaluate.layer_display import COVERAGE, display_environment, display_layers
from octasplat.engine.evaluate.other_world import OtherWorldCheck
from octasplat.engine.evaluate.report import write_report
from octasplat.engine.evaluate.view_metrics import (
    MeasuredView,
    RenderedView,
    ViewMetrics,
    depth_spread,
    measure_view,
    summarize_views,
)
from octasplat.engine.evaluate.view_support import coverage_picture, grid_stride, measure_support
from octasplat.engine.gaussians.materials import ALBEDO
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.pathtracing.environment import EnvironmentMap
from octasplat.engine.pathtracing.relighting.relighter import Relighter
from octasplat.engine.render.file_names import unique_render_names
from octasplat.engine.render.image_files import write_png
from octasplat.engine.render.renderer import background_color, front_normals
from octasplat.engine.render.supersampling import RADIANCE_RAYS_PER_SIDE, render_filtered
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import Tracer, TraceSettings
from octasplat.engine.train.shading_factory import find_background, find_exposures, shading_for_view

MAX_COVERAGE_VIEWS = 24
"""Held-out views whose coverage is measured."""
MAX_VIEWS_AT_ONCE = 4
MAX_PIXELS_AT_ONCE = 1 << 22
"""Most views that are measured and written side by side, and most pixels of these together where that are
several: each pixel takes some 130 bytes."""
RENDERS, LAYERS, METRICS, REPORT = "renders", "layers", "metrics.json", "report.html"


def evaluate_held_out(
    dataset: Dataset,
    gaussians: FlatGaussians,
    output: Path,
    *,
    settings: TraceSettings,
    shading: ShadingModel,
    background: str,
    run: Mapping[str, object],
    config: Mapping[str, object],
    threads: int,
    progress: EventListener,
    truth: GroundTruth | None = None,
    environment: EnvironmentMap | None = None,
    relighter: Relighter | None = None,
    check: OtherWorldCheck | None = None,
    are_held_out: bool = True,
) -> None:
    """Measure ``gaussians`` on the held-out views of ``dataset``.

    Args:
        dataset: photographs and split.
        gaussians: the scene.
        output: folder that receives ``renders/<name>.png``, ``metrics.json`` and ``report.html``, and where
            there are materials ``layers/<layer>/<name>.png`` and ``layers/environment.png``.
        settings: where rays end, as in training.
        shading: what the scene was trained with.
        background: ``black`` or ``white``, behind renders and behind photographs with alpha.
        run: facts about the run that join the metrics.
        config: shown in the report.
        threads: for rendering and measuring; 0 means all cores.
        progress: receives the progress events.
        truth: of the scene, whose measures then join the metrics as ``truth``.
        environment: the map that the scene was learnt with.
        relighter: shows the scene in other light, for what the truth knows of that.
        check: warns if the photographs are of another world than the scene.
        are_held_out: whether the training has seen none of these views; the report says so.
    """
    tracer = make_tracer(settings, threads=threads)
    tracer.build(gaussians, shading.features(gaussians))
    measures = None if truth is None else GroundTruthMeasures(truth)
    warnings: list[Warned] = []
    if check is not None:
        warnings = _as_warnings(check.warn_of_cameras(dataset.viewpoints, gaussians), progress)
    rows: list[ViewMetrics] = []
    facts: dict[str, ViewFacts] = {}
    images = WorstAndBestViews()
    photographs = [view.name for view in dataset.views]
    names = dict(zip(photographs, unique_render_names(photographs), strict=True))
    for view, measured, known in _finish_views(
        _render_views(dataset, tracer, shading, background, measures),
        lambda view: _write_images(view, output, names[view.name]),
        views_at_once(
            (
                dataset.views[index].width_px * dataset.views[index].height_px
                for index in dataset.test_indices
            ),
            threads or threads_in_use(),
        ),
        threads or threads_in_use(),
    ):
        rows.append(measured.metrics)
        facts[view.name] = known
        if check is not None:
            check.add(view, measured.metrics.psnr)
        images.offer(
            view.name,
            measured.metrics.psnr,
            ViewImages(view.reference, view.render, measured.flip_map, _report_layers(view)),
        )
        progress(PhaseProgress("evaluate", len(rows), len(dataset.test_indices)))
    # One warning of another world is enough.
    if check is not None and not warnings:
        warnings = _as_warnings(check.warn_of_renders(), progress)
    if measures is not None and environment is not None:
        measures.add_light(dataset, environment, relighter, progress)
    if measures is not None and (measures.rows or measures.light):
        run = {**run, "truth": measures.as_dict()}
    if environment is not None:
        write_png(output / LAYERS / "environment.png", display_environment(environment.radiance_linear))
    behind = find_background(shading)
    advice = advise(
        rows,
        facts,
        training_psnr=_training_psnr(run),
        learns_exposure=find_exposures(shading) is not None,
        are_held_out=are_held_out,
    )
    stated = {"advice": list(advice)} if advice else {}
    covered = {"coverage": groups} if (groups := support_groups(facts)) else {}
    seen = {} if are_held_out else {"held_out": False}
    metrics = summarize_views(rows).as_dict({**run, **seen, **covered, **stated})
    write_json(output / METRICS, metrics)
    write_report(
        output / REPORT,
        title=dataset.root.name,
        metrics=metrics,
        events=[*read_events(output / "events.jsonl"), *(warning.as_dict() for warning in warnings)],
        config=config,
        images=images,
        environment_linear=None if environment is None else environment.radiance_linear,
        background_srgb=None if behind is None else behind.rgb_srgb,
    )


def _training_psnr(run: Mapping[str, object]) -> float | None:
    known = run.get("training_views")
    value = known.get("psnr") if isinstance(known, Mapping) else None
    return float(value) if isinstance(value, int | float) else None


def _write_images(view: RenderedView, output: Path, name: str) -> None:
    write_png(output / RENDERS / f"{name}.png", view.render)
    if ALBEDO in view.layers:
        for layer, display in view.layers.items():
            write_png(output / LAYERS / layer / f"{name}.png", display)


def _report_layers(view: RenderedView) -> dict[str, Float32[np.ndarray, "h w 3"]]:
    """Return the layers of a view that the report shows: its own, and its coverage where that is known."""
    layers = dict(view.layers)
    if view.support is not None:
        height, width = view.weight.shape
        layers[COVERAGE] = coverage_picture(view.support, width, height, grid_stride(height, width))
    return layers


def _as_warnings(message: str | None, progress: EventListener) -> list[Warned]:
    """Emit a warning, if there is one, and return what was emitted."""
    warnings = [] if message is None else [Warned(message)]
    for warning in warnings:
        progress(warning)
    return warnings


def _render_views(
    dataset: Dataset,
    tracer: Tracer,
    shading: ShadingModel,
    background: str,
    measures: GroundTruthMeasures | None,
) -> Iterator[RenderedView]:
    color = background_color(background)
    asked = _views_to_ask(dataset)
    for index in dataset.test_indices:
        rgb, alpha, weight = dataset.view_image(int(index))
        rays = dataset.view_rays(int(index))
        image = render_filtered(
            tracer, rays, color, shading_for_view(shading, int(index)), RADIANCE_RAYS_PER_SIDE
        )
        if measures is not None:
            image = replace(image, normal_world=front_normals(tracer, rays, image.depth_median))
            view = dataset.views[index]
            measures.add(view.name, image, rays, view.rotation_cam_from_world[2])
        reference = composite_over(rgb, alpha, color)
        support = None
        if int(index) in asked:
            error = ((image.rgb_srgb - reference).astype(np.float64) ** 2).mean(axis=2)
            support = measure_support(
                dataset, tracer, rays, image.depth_median, error, weight, grid_stride(*weight.shape)
            )
        yield RenderedView(
            name=dataset.views[index].name,
            render=image.rgb_srgb,
            reference=reference,
            weight=weight,
            alpha=alpha if dataset.has_alpha else None,
            layers=display_layers(image),
            support=support,
            depth_spread=depth_spread(image.depth, image.depth_median, weight),
        )


def _views_to_ask(dataset: Dataset) -> set[int]:
    """Return the held-out views whose coverage by training views is measured, evenly chosen among many."""
    if len(dataset.train_indices) == 0:
        return set()
    count = min(len(dataset.test_indices), MAX_COVERAGE_VIEWS)
    places = np.linspace(0, len(dataset.test_indices) - 1, count).round().astype(np.int64)
    return set(dataset.test_indices[places].tolist())


def views_at_once(pixels: Iterable[int], threads: int) -> int:
    """Return how many views of so many pixels each are measured and written side by side.

    >>> views_at_once([800 * 533], 8), views_at_once([1600 * 1200], 8), views_at_once([4000 * 3000], 8)
    (4, 2, 1)
    """
    largest = max(pixels, default=1)
    return min(threads, MAX_VIEWS_AT_ONCE, max(1, MAX_PIXELS_AT_ONCE // largest))


class _FinishedView(NamedTuple):
    view: RenderedView
    measured: MeasuredView
    facts: ViewFacts


def _finish_views(
    views: Iterator[RenderedView], write: Callable[[RenderedView], None], workers: int, threads: int
) -> Iterator[_FinishedView]:
    """Measure and write so many views as there are workers side by side, in order.

    Kernels, numpy and the writing of files release the interpreter's lock. Threads beyond the workers share
    the kernels.
    """

    def finish(view: RenderedView) -> _FinishedView:
        measured = measure_view(view, threads // workers)
        write(view)
        facts = ViewFacts(
            fine_detail(view.reference, view.weight),
            fine_detail(view.render, view.weight),
            view.support,
            common_structure(view.render, view.reference, view.weight),
        )
        return _FinishedView(view, measured, facts)

    if workers == 1:
        yield from map(finish, views)
        return
    with ThreadPoolExecutor(workers) as pool:
        yield from read_ahead(finish, views, pool, workers + 1)
