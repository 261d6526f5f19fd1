"""The report: one self-contained HTML page with figures, curves, and every view beside its photograph.

The page needs no other file and no network; what it shows is escaped by the template, so that names of files
and settings cannot change it.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from jinja2 import Environment, PackageLoader, StrictUndefined, Template, select_autoescape

from octasplat.engine.core.errors import OutputError
from octasplat.engine.core.georeference import Georeference
from octasplat.engine.core.writing import write_text
from octasplat.engine.evaluate.curves import format_axis_duration, training_charts
from octasplat.engine.evaluate.gallery import (
    BEST_COUNT,
    MAGMA,
    MAX_SIDE_PX,
    WORST_COUNT,
    ViewImages,
    embedded_names,
    magma,
    webp_data_uri,
)
from octasplat.engine.evaluate.layer_display import LABELS, display_environment
from octasplat.engine.render.image_files import shrink_to


@dataclass(frozen=True)
class Column:
    """A metric of the table: its key in ``metrics.json``, heading, decimals, and which end is better."""

    key: str
    heading: str
    decimals: int
    higher_is_better: bool


COLUMNS = (
    Column("psnr", "PSNR", 2, True),
    Column("psnr_colour_corrected", "PSNR cc", 2, True),
    Column("psnr_foreground", "PSNR fg", 2, True),
    Column("ssim", "SSIM", 4, True),
    Column("ssim_valid", "SSIM valid", 4, True),
    Column("ms_ssim", "MS-SSIM", 4, True),
    Column("flip", "FLIP", 4, False),
    Column("depth_spread", "Spread", 3, False),
)

MIN_EXPOSURE_GAIN_DB = 0.3
_LABELS = {"photograph": "Photograph", "render": "Render", "flip": "FLIP error map"}
_TRUTH_TILES = (
    ("normal_mae", "Normals", 2, "degrees"),
    ("depth_mae", "Depth", 4, "units"),
    ("albedo_psnr_scaled", "Albedo", 2, "dB"),
    ("roughness_mae", "Roughness", 3, "off"),
    ("metallic_mae", "Metallic", 3, "off"),
    ("environment_psnr_scaled", "Environment", 2, "dB"),
    ("relight_psnr_scaled", "Relit", 2, "dB"),
)
_NOTES = {
    "psnr_colour_corrected": "exposure left out",
    "ssim": "as in 3DGS, zero padding",
    "flip": "lower is better",
    "depth_spread": "of depth, share of pixels; lower is better",
}


def write_report(
    path: Path,
    *,
    title: str,
    metrics: Mapping[str, object],
    events: Sequence[Mapping[str, object]],
    config: Mapping[str, object],
    images: Mapping[str, ViewImages],
    environment_linear: Float32[np.ndarray, "h w 3"] | None = None,
    background_srgb: Float32[np.ndarray, "a b 3"] | None = None,
) -> None:
    """Write the report page, atomically.

    Args:
        path: Where to, ``report.html`` by custom.
        title: Name of the scene.
        metrics: Content of ``metrics.json``; only ``mean`` and ``views`` must be there.
        events: Rows of ``events.jsonl``: curves, warnings and times of the stages are taken from them.
        config: Settings of the run, nested as in ``config.json``.
        images: Pictures by view name. Views without any are in the table only; of more than 16, the 12
            worst and 4 best are embedded, and no others are asked for, so that the mapping may load lazily.
        environment_linear: The map that a scene with materials was learnt with.
        background_srgb: The map that a scene was learnt before.

    Raises:
        OutputError: The page cannot be written.
    """
    page = _template().render(
        _template_values(title, metrics, events, config, images),
        environment=None if environment_linear is None else _embedded_environment(environment_linear),
        background=None if background_srgb is None else _embedded_map(background_srgb),
    )
    try:
        write_text(path, page)
    except OSError as error:
        raise OutputError(f"Cannot write {path}: {error.strerror or error}.") from error


@cache
def _template() -> Template:
    """Return the page's template; to compile it takes longer than to fill it in."""
    environment = Environment(
        loader=PackageLoader("octasplat.engine.evaluate", package_path=""),
        autoescape=select_autoescape(["html"]),
        undefined=StrictUndefined,  # a misspelled name is an error
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("report.html")


def _template_values(
    title: str,
    metrics: Mapping[str, object],
    events: Sequence[Mapping[str, object]],
    config: Mapping[str, object],
    images: Mapping[str, ViewImages],
) -> dict[str, object]:
    """Return the values that the page template needs."""
    mean = _as_mapping(metrics.get("mean"))
    views = {name: _as_mapping(row) for name, row in _as_mapping(metrics.get("views")).items()}
    columns = _metric_columns(mean)
    # Views without a PSNR come last.
    worst_first = sorted(views, key=lambda name: (_as_number(views[name].get("psnr"), math.inf), name))
    embedded = embedded_names(worst_first, images)
    interval = metrics.get("mean_psnr_ci95")
    layers = [name for name in LABELS if any(name in images[view].layers for view in embedded)]
    return {
        "labels": {**_LABELS, **{name: LABELS[name] for name in layers}},
        "tabs": layers,
        "title": title,
        "tiles": _summary_tiles(mean, columns, interval, metrics),
        "facts": _run_facts(metrics, len(views)),
        "stages": _phase_times(events),
        "charts": training_charts(events),
        "columns": columns,
        "rows": _view_rows(worst_first, views, columns, embedded),
        "figures": [_view_figure(name, views[name], images[name]) for name in embedded],
        "left_out": len(views) - len(embedded),
        "thinned": len(embedded) < len(views)
        and embedded == [*worst_first[:WORST_COUNT], *worst_first[-BEST_COUNT:]],
        "worst": WORST_COUNT,
        "best": BEST_COUNT,
        "magma": [f"rgb({r} {g} {b})" for r, g, b in (MAGMA * 255).round().astype(int).tolist()],
        "settings": _flatten_settings(config),
        "versions": _flatten_settings(_as_mapping(metrics.get("versions"))),
        "definitions": [
            *_as_mapping(metrics.get("definitions")).items(),
            *_as_mapping(_as_mapping(metrics.get("truth")).get("definitions")).items(),
        ],
        "advice": [str(line) for line in _as_list(metrics.get("advice"))],
        "warnings": list(dict.fromkeys(str(e.get("message")) for e in events if e.get("kind") == "warning")),
    }


def _as_list(value: object) -> Sequence[object]:
    return value if isinstance(value, list | tuple) else ()


def _embedded_map(rgb_srgb: Float32[np.ndarray, "h w 3"]) -> dict[str, object]:
    """Return the data URI and size of a map."""
    height, width = rgb_srgb.shape[:2]
    return {"uri": webp_data_uri(shrink_to(rgb_srgb, MAX_SIDE_PX)), "width": width, "height": height}


def _embedded_environment(radiance_linear: Float32[np.ndarray, "h w 3"]) -> dict[str, object]:
    """Return the data URI, size and maximum radiance of an environment map."""
    return {
        **_embedded_map(display_environment(radiance_linear)),
        "brightest": _format_value(float(radiance_linear.max()), 1),
    }


def _metric_columns(mean: Mapping[str, object]) -> list[Column]:
    """Return the measured metrics; color-corrected PSNR only where the correction makes a difference."""
    columns = [column for column in COLUMNS if column.key in mean]
    plain, corrected = (_as_number(mean.get(key), math.nan) for key in ("psnr", "psnr_colour_corrected"))
    # Not-a-number, where one of them is missing, fails the comparison.
    if corrected - plain >= MIN_EXPOSURE_GAIN_DB:
        return columns
    return [column for column in columns if column.key != "psnr_colour_corrected"]


def _summary_tiles(
    mean: Mapping[str, object], columns: Sequence[Column], interval: object, metrics: Mapping[str, object]
) -> list[dict[str, str]]:
    """Return the main figures at the head of the page."""
    tiles = []
    for column in columns:
        if column.key != "ssim_valid":
            note = _NOTES.get(column.key, "")
            if column.key == "psnr" and isinstance(interval, list | tuple):
                low, high = (_format_value(bound, 2) for bound in interval)
                note = f"95 % interval {low} – {high}"
            unit = "dB" if column.key.startswith("psnr") else ""
            value = _format_value(mean[column.key], column.decimals)
            tiles.append({"label": column.heading, "value": value, "unit": unit, "note": note})
    trained = _as_mapping(metrics.get("training_views"))
    if trained.get("psnr") is not None:
        note = f"worst {_format_value(trained.get('worst_psnr'), 2)} dB: {trained.get('worst')}"
        if left := trained.get("left_out"):
            note += f"; {len(left) if isinstance(left, list) else 0} left out"
        tiles.append(
            {
                "label": "Training views",
                "value": _format_value(trained["psnr"], 2),
                "unit": "dB",
                "note": note,
            }
        )
    known = _as_mapping(_as_mapping(metrics.get("truth")).get("mean"))
    for key, label, decimals, unit in _TRUTH_TILES:
        if known.get(key) is not None:
            note = "against the truth" + (", one factor a channel" if key.endswith("_scaled") else "")
            tiles.append(
                {"label": label, "value": _format_value(known[key], decimals), "unit": unit, "note": note}
            )
    gaussians = metrics.get("gaussians")
    if isinstance(gaussians, int):
        tiles.append({"label": "Gaussians", "value": _format_thousands(gaussians), "unit": "", "note": ""})
    seconds = metrics.get("seconds")
    if isinstance(seconds, int | float):
        iterations, planned = metrics.get("iterations"), metrics.get("planned_iterations")
        note = f"{_format_thousands(iterations)} iterations" if isinstance(iterations, int) else ""
        if note and isinstance(planned, int):
            note += f" of {_format_thousands(planned)}, as no more was gained"
        tiles.append(
            {"label": "Time", "value": format_axis_duration(float(seconds)), "unit": "", "note": note}
        )
    return tiles


def _run_facts(metrics: Mapping[str, object], views: int) -> list[str]:
    """Return short statements for the line under the title."""
    noun = "held-out view" if metrics.get("held_out", True) else "view"
    facts = [f"{views} {noun}{'' if views == 1 else 's'}"]
    resolution = metrics.get("resolution")
    if isinstance(resolution, Mapping):
        known = {key: value for key, value in resolution.items() if value is not None}
        settings_text = ", ".join(
            f"{key.replace('_', ' ')} {value}" for key, value in _flatten_settings(known)
        )
        facts.append(f"resolution: {settings_text or 'that of the photographs'}")
    elif resolution is not None:
        facts.append(f"resolution {resolution}")
    if metrics.get("seed") is not None:
        facts.append(f"seed {metrics['seed']}")
    if (place := metrics.get("georeference")) is not None:
        facts += Georeference.model_validate(place).facts()
    if taken := metrics.get("taken_near"):
        facts.append(
            f"{_format_thousands(int(_as_number(taken, 0)))} Gaussians too near to a camera were taken away"
        )
    return facts


def _phase_times(events: Sequence[Mapping[str, object]]) -> list[dict[str, object]]:
    """Return the duration of each phase (its last finish), with its share of the total."""
    spent = {
        str(row.get("stage")): _as_number(row.get("seconds"), 0.0)
        for row in events
        if row.get("kind") == "stage_finished"
    }
    total = sum(spent.values())
    if total <= 0:
        return []
    return [
        {"name": name, "time": format_axis_duration(seconds), "share": round(100 * seconds / total, 2)}
        for name, seconds in spent.items()
    ]


def _view_rows(
    worst_first: list[str],
    views: Mapping[str, Mapping[str, object]],
    columns: list[Column],
    embedded: list[str],
) -> list[dict[str, object]]:
    """Return the rows of the table of views, worst view first."""
    known = [_as_number(views[name].get("psnr"), math.nan) for name in worst_first]
    finite = [value for value in known if math.isfinite(value)]
    low, high = (min(finite), max(finite)) if finite else (0.0, 0.0)
    place = {name: index for index, name in enumerate(embedded)}
    rows: list[dict[str, object]] = []
    for name, psnr in zip(worst_first, known, strict=True):
        view = views[name]
        share = 100.0 if not math.isfinite(psnr) or high == low else 100 * (psnr - low) / (high - low)
        cells = [
            {"value": view.get(column.key), "text": _format_value(view.get(column.key), column.decimals)}
            for column in columns
        ]
        size = f"{view['width']} × {view['height']}" if "width" in view and "height" in view else "–"
        pixels = _as_number(view.get("width"), 0.0) * _as_number(view.get("height"), 0.0)
        rows.append(
            {
                "name": name,
                "figure": place.get(name),
                "cells": cells,
                "size": size,
                "pixels": pixels,
                "share": round(share, 1),
            }
        )
    return rows


def _view_figure(name: str, view: Mapping[str, object], images: ViewImages) -> dict[str, object]:
    """Return the three images of a view and their caption."""
    small = images.downscale()
    height, width = small.flip_map.shape
    summary = " · ".join(
        f"{column.heading} {_format_value(view[column.key], column.decimals)}"
        for column in COLUMNS
        if view.get(column.key) is not None and column.key in ("psnr", "ssim", "flip")
    )
    return {
        "name": name,
        "summary": summary,
        "psnr": _format_value(view.get("psnr"), 2),
        "width": width,
        "height": height,
        "layers": [
            ("photograph", webp_data_uri(small.photograph)),
            ("render", webp_data_uri(small.render)),
            ("flip", webp_data_uri(magma(small.flip_map))),
            *((layer, webp_data_uri(picture)) for layer, picture in small.layers.items() if layer in LABELS),
        ],
    }


def _flatten_settings(values: Mapping[str, object], prefix: str = "") -> list[tuple[str, str]]:
    """Return nested settings as dotted names and short texts."""
    rows: list[tuple[str, str]] = []
    for key, value in values.items():
        if isinstance(value, Mapping):
            rows += _flatten_settings(value, f"{prefix}{key}.")
        else:
            rows.append(
                (f"{prefix}{key}", value if isinstance(value, str) else json.dumps(value, default=str))
            )
    return rows


def _as_mapping(value: object) -> Mapping[str, object]:
    return value if isinstance(value, Mapping) else {}


def _as_number(value: object, otherwise: float) -> float:
    # In Python the JSON values true and false are numbers.
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else otherwise


def _format_value(value: object, decimals: int) -> str:
    return f"{value:.{decimals}f}" if isinstance(value, int | float) and math.isfinite(value) else "–"


def _format_thousands(value: int) -> str:
    return f"{value:,}".replace(",", "\u202f")  # narrow no-break space
