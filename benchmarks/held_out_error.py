"""Where the held-out error of finished runs comes from: what PSNR would be if one cause alone were gone.

    python -m benchmarks.held_out_error RUN... [--dataset FOLDER] [--json FILE] [--pictures FOLDER]

For each run the held-out views are rendered and held against their photographs as they are, and after one
fit each: of color, of a smooth gain, of a shift, of a homography, of a motion of each place, and of the
colors of all Gaussians to every other pixel of the view (measured on the others). Renders without harmonics,
and with each Gaussian's color as the nearest training camera sees it, show what colors by direction do.
Errors are also counted by the number of training views that see a place, by depth at sparse points, and by
spatial frequency. Training views, as many and evenly chosen, stand beside them.
``docs/notes/held_out_error.md`` says how to read it.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from benchmarks.picture_measures import BAND_NAMES, measure_pair
from benchmarks.view_colors import fitted_colors_picture, nearest_directions, with_frozen_colors
from octasplat.engine.core.color import composite_over
from octasplat.engine.core.psnr import psnr
from octasplat.engine.core.rays import ImageRays
from octasplat.engine.core.threads import threads_in_use, use_threads
from octasplat.engine.core.writing import write_json
from octasplat.engine.dataset import Dataset
from octasplat.engine.evaluate.metrics import quantize_8_bit
from octasplat.engine.evaluate.view_support import (
    GROUP_NAMES,
    PointDepths,
    Support,
    gain_if_covered,
    group_errors,
    measure_points,
    measure_support,
    psnr_of,
)
from octasplat.engine.files.gaussian_ply import read_gaussian_ply
from octasplat.engine.gaussians.materials import has_materials
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.image_files import write_png
from octasplat.engine.render.renderer import RenderedImage, background_color, render_rays
from octasplat.engine.runs.config import read_config
from octasplat.engine.runs.finished_shading import finished_shading, shown_options
from octasplat.engine.runs.run_dataset import open_run_dataset
from octasplat.engine.runs.run_folder import CONFIG, SCENE, found_model_folder, photographs_folder, run_extent
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import Tracer
from octasplat.engine.train.shading_factory import shading_for_view

Picture = Float32[np.ndarray, "h w 3"]

ROWS = {
    "psnr": "as it is",
    "gain_and_offset": "gain and offset of each channel",
    "affine_color": "best affine color",
    "local_gain": "best smooth gain",
    "shift": "best shift",
    "homography": "best homography",
    "local_motion": "best motion of each place",
    "color_and_motion": "smooth gain and motion of each place",
    "frozen_colors": "colors as the nearest training camera sees them",
    "degree_0": "without higher harmonics",
    "fitted_colors": "colors fitted to every other pixel of the view",
}
"""The rows of the table by their names in the JSON; PSNR in dB."""


@dataclass(frozen=True)
class View:
    """One view of a run beside its photograph, and its Gaussians' picture with other colors."""

    name: str
    render: Picture
    reference: Picture
    weight: Float32[np.ndarray, "h w"]
    others: dict[str, float]
    support: Support | None = None
    points: PointDepths | None = None


class Run:
    """A finished run with its photographs, ready to be rendered."""

    def __init__(self, folder: Path, photographs: Path | None, threads: int) -> None:
        config = read_config(folder / CONFIG)
        self.folder = folder
        self.dataset: Dataset = open_run_dataset(
            photographs_folder(folder, photographs), folder, config, threads, lambda _event: None,
            model_folder=found_model_folder(folder),
        )  # fmt: skip
        self.gaussians, _ = read_gaussian_ply(folder / SCENE)
        if has_materials(self.gaussians):
            sys.exit(f"{folder} has materials, whose colors are not the Gaussians' own; name a run without.")
        extent = run_extent(folder, self.dataset.extent)
        names = [view.name for view in self.dataset.views]
        self.shading: ShadingModel = finished_shading(
            folder, shown_options(config.train, self.gaussians), extent, names
        )
        self.background = background_color(config.evaluation_background)
        self._make = lambda: make_tracer(config.train.trace, threads=threads)
        self.tracer = self.tracer_of(self.gaussians)

    def tracer_of(self, gaussians: FlatGaussians) -> Tracer:
        """Return a tracer built around Gaussians."""
        tracer = self._make()
        tracer.build(gaussians)
        return tracer

    def render(self, tracer: Tracer, image: ImageRays, index: int) -> RenderedImage:
        """Return what a tracer's Gaussians show of a view, as exposed as that is."""
        return render_rays(tracer, image, self.background, shading_for_view(self.shading, index))

    def photograph(self, index: int) -> tuple[Picture, Float32[np.ndarray, "h w"]]:
        """Return a view's photograph over the background of the evaluation, and the weights of its pixels."""
        rgb, alpha, weight = self.dataset.view_image(index)
        return quantize_8_bit(composite_over(rgb, alpha, self.background)), weight


def held_out_views(run: Run, stride: int) -> Iterable[View]:
    """Yield the held-out views with all that wants the scene."""
    dataset = run.dataset
    cameras = np.stack([dataset.views[i].origin_world for i in dataset.train_indices.tolist()])
    plain = run.tracer_of(run.gaussians.with_base_color_only())
    for index in dataset.test_indices.tolist():
        image = dataset.view_rays(index)
        reference, weight = run.photograph(index)
        rendered = run.render(run.tracer, image, index)
        render = quantize_8_bit(rendered.rgb_srgb)
        squared = np.square(render.astype(np.float64) - reference).mean(axis=-1)
        directions = nearest_directions(run.gaussians.means_world, dataset.views[index].origin_world, cameras)
        frozen = run.tracer_of(with_frozen_colors(run.gaussians, directions))
        others = {
            name: psnr(quantize_8_bit(run.render(tracer, image, index).rgb_srgb), reference, weight)
            for name, tracer in (("frozen_colors", frozen), ("degree_0", plain))
        }
        fitted, left_out = fitted_colors_picture(
            run.tracer, run.gaussians, image, rendered.rgb_srgb, reference, weight
        )
        others["fitted_colors"] = psnr(quantize_8_bit(fitted), reference, weight * left_out)
        support = measure_support(dataset, run.tracer, image, rendered.depth_median, squared, weight, stride)
        points = measure_points(dataset, index, rendered.depth_median, squared)
        yield View(dataset.views[index].name, render, reference, weight, others, support, points)


def training_views(run: Run, count: int) -> Iterable[View]:
    """Yield as many training views, evenly chosen."""
    chosen = np.linspace(0, len(run.dataset.train_indices) - 1, min(count, len(run.dataset.train_indices)))
    for index in run.dataset.train_indices[np.round(chosen).astype(np.int64)].tolist():
        reference, weight = run.photograph(index)
        rendered = run.render(run.tracer, run.dataset.view_rays(index), index)
        yield View(run.dataset.views[index].name, quantize_8_bit(rendered.rgb_srgb), reference, weight, {})


def measure_pictures(view: View) -> dict[str, object]:
    """Return all figures of one view."""
    return {**measure_pair(view.render, view.reference, view.weight), **view.others}


def analyse(run: Run, stride: int, pictures: Path | None) -> dict[str, object]:
    """Return all that is known of a run's held-out views, and of as many training views."""
    found: dict[str, object] = {"run": run.folder.name, "gaussians": len(run.gaussians)}
    support: list[Support] = []
    points: list[PointDepths] = []

    def taken(views: Iterable[View]) -> Iterable[View]:
        for view in views:
            if view.support is not None and view.points is not None:
                support.append(view.support)
                points.append(view.points)
            yield view

    held_out = _measured(taken(held_out_views(run, stride)), pictures)
    training = _measured(training_views(run, len(run.dataset.test_indices)), None)
    for name, rows in (("held_out", held_out), ("training", training)):
        found[name] = {"mean": _means(list(rows.values())), "views": rows}
    found["coverage"] = groups = group_errors(support)
    found["gain_if_covered_db"] = gain_if_covered(groups)
    relative = np.concatenate([part.relative for part in points])
    wrong = np.concatenate([part.wrong for part in points])
    errors = np.concatenate([part.errors for part in points])
    if len(relative):
        found["depths"] = {
            "points": len(relative),
            "median_off": float(np.median(np.abs(relative))),
            "wrong": float(wrong.mean()),
            "psnr_right": psnr_of(float(errors[~wrong].mean())) if (~wrong).any() else None,
            "psnr_wrong": psnr_of(float(errors[wrong].mean())) if wrong.any() else None,
        }
    return found


def _measured(views: Iterable[View], pictures: Path | None) -> dict[str, dict[str, object]]:
    """Measure views side by side while the next ones are rendered."""
    with ThreadPoolExecutor(max(1, threads_in_use())) as pool:
        waiting = []
        for view in views:
            waiting.append((view.name, pool.submit(measure_pictures, view)))
            if pictures is not None:
                error = np.abs(view.render - view.reference) * view.weight[..., None]
                beside = np.concatenate([view.reference, view.render, np.clip(3 * error, 0, 1)], axis=1)
                write_png(pictures / f"{Path(view.name).stem}.png", beside)
        return {name: future.result() for name, future in waiting}


def _means(rows: Sequence[dict[str, object]]) -> dict[str, object]:
    """Return the means over views of all that are numbers, or lists of numbers, where they are finite."""
    found: dict[str, object] = {}
    for key in rows[0] if rows else ():
        values = np.array([np.abs(row[key]) if key == "shift_px" else row[key] for row in rows], np.float64)
        finite = values[np.isfinite(values.reshape(len(values), -1)).all(axis=1)]
        if len(finite):
            found[key] = finite.mean(axis=0).tolist()
    return found


def table(results: Sequence[dict[str, object]]) -> str:
    """Return the results as tables of Markdown, a column for each run."""
    lines = _header("held out / training views, dB", results)
    for key, title in ROWS.items():
        lines.append(_row(title, results, lambda result, key=key: _pair(result, key)))
    lines.append(_row("shift, px", results, lambda r: _pair(r, "shift_px", np.linalg.norm)))
    lines.append(_row("motion of each place, px", results, lambda r: _pair(r, "local_motion_px")))
    lines += ["", *_header("power of the render over the photograph's, dB", results)]
    for number, name in enumerate(BAND_NAMES):
        lines.append(
            _row(name, results, lambda r, n=number: _pair(r, "sharpness_db", lambda v: v[n], digits=1))
        )
    lines += ["", *_header("share of the squared error", results)]
    for number, name in enumerate(BAND_NAMES):
        lines.append(_row(name, results, lambda r, n=number: _pair(r, "error_by_band", lambda v: v[n])))
    lines += ["", *_header("training views within 15 degrees: pixels, error, PSNR", results)]
    for name in ("nothing met", *GROUP_NAMES):
        lines.append(_row(name, results, lambda r, name=name: _group(r["coverage"].get(name))))
    lines.append(_row("dB, were 0 to 2 as good as more", results, _covered))
    lines += ["", *_header("depth at sparse points: median off, wrong, PSNR right / wrong", results)]
    lines.append(_row("", results, lambda r: _depths(r.get("depths"))))
    return "\n".join(lines)


def _header(title: str, results: Sequence[dict[str, object]]) -> list[str]:
    return [_row(title, results, lambda result: str(result["run"])), "|" + "---|" * (len(results) + 1)]


def _row(title: str, results: Sequence[dict[str, object]], cell: Callable[..., str]) -> str:
    return "| " + " | ".join([title, *(cell(result) for result in results)]) + " |"


def _pair(result: dict, key: str, of: Callable[..., float] = float, digits: int = 2) -> str:  # type: ignore[type-arg]
    both = [result[part]["mean"].get(key) for part in ("held_out", "training")]
    return " / ".join(f"{of(value):.{digits}f}" for value in both if value is not None)


def _group(group: dict[str, float] | None) -> str:
    return "" if group is None else f"{group['pixels']:.0%}, {group['error']:.0%}, {group['psnr']:.1f}"


def _covered(result: dict) -> str:  # type: ignore[type-arg]
    gain = result["gain_if_covered_db"]
    return "" if gain is None else f"+{gain:.2f}"


def _depths(depths: dict[str, float] | None) -> str:
    if depths is None:
        return ""
    values = [depths["psnr_right"], depths["psnr_wrong"]]
    told = " / ".join("-" if value is None else f"{value:.1f}" for value in values)
    return f"{depths['median_off']:.2%}, {depths['wrong']:.1%}, {told}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure runs, print the tables, and write the JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument(
        "--dataset", type=Path, help="the photographs of one run, where they are elsewhere now"
    )
    parser.add_argument("--json", type=Path, help="all figures, view by view")
    parser.add_argument(
        "--pictures", type=Path, help="photograph, render and three times the error, side by side"
    )
    parser.add_argument("--stride", type=int, default=6, help="pixels between two whose coverage is asked")
    parser.add_argument("--threads", type=int, default=0)
    given = parser.parse_args(arguments)
    use_threads(given.threads)
    results = []
    for folder in given.runs:
        pictures = None if given.pictures is None else given.pictures / folder.name
        results.append(analyse(Run(folder, given.dataset, given.threads), given.stride, pictures))
        if given.json is not None:
            write_json(given.json, json.loads(json.dumps(results)))
    print(table(results))


if __name__ == "__main__":
    main()
