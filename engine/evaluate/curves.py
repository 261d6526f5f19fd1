"""Training curves as geometry for inline SVG: scales, ticks and polylines, drawn by the report's template."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

WIDTH, HEIGHT = 420, 240
LEFT, RIGHT, TOP, BOTTOM = 52, 12, 12, 34
MAX_POINTS = 300
"""Of one curve on the page; more would not be seen at its width."""

Row = Mapping[str, object]


@dataclass(frozen=True)
class Tick:
    """A labelled position along an axis, in SVG units."""

    position: float
    label: str


@dataclass(frozen=True)
class Curve:
    """One line of a chart; ``points`` are SVG coordinates and ``style`` a class of the template's."""

    label: str
    style: str
    points: tuple[tuple[float, float], ...]

    @property
    def path(self) -> str:
        """Return the points as the ``points`` attribute of an SVG polyline."""
        return " ".join(f"{x:g},{y:g}" for x, y in self.points)


@dataclass(frozen=True)
class Chart:
    """A chart ready to be drawn.

    Attributes:
        title: What is shown.
        x_key: ``iteration`` or ``seconds``.
        x_label: Under the horizontal axis.
        unit: Of the vertical axis, may be empty.
        x_range: Values at the left and right edge of the plot.
        y_range: Values at its bottom and top; logarithms to base 10 if ``logarithmic``.
        logarithmic: Whether the vertical axis is.
        x_ticks: Along the bottom.
        y_ticks: Along the left.
        curves: The lines.
    """

    title: str
    x_key: str
    x_label: str
    unit: str
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    logarithmic: bool
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]
    curves: tuple[Curve, ...]


@dataclass(frozen=True)
class _SeriesSource:
    """Where the values of one line of a chart come from: the kind of the event rows, and their key."""

    kind: str
    key: str
    label: str
    style: str


MAX_TIME_INTERVALS = 5
"""Most intervals between ticks of an axis of time."""
MIN_TIME_RANGE_SECONDS = 3.0
"""Shorter ranges have ticks at fractions of a second."""


@dataclass(frozen=True)
class _ChartSource:
    """Series of a chart; ``y_from_zero`` begins the vertical axis at exactly 0."""

    title: str
    unit: str
    series: tuple[_SeriesSource, ...]
    logarithmic: bool = False
    y_from_zero: bool = False


_CHARTS = (
    _ChartSource(
        "PSNR",
        "dB",
        (
            _SeriesSource("training_progress", "psnr", "training rays", "quiet"),
            _SeriesSource("held_out_measured", "psnr", "held-out views", "main"),
        ),
    ),
    _ChartSource("Loss", "", (_SeriesSource("training_progress", "loss", "loss", "main"),), logarithmic=True),
    _ChartSource(
        "Gaussians",
        "",
        (_SeriesSource("training_progress", "gaussians", "Gaussians", "main"),),
        y_from_zero=True,
    ),
)


def training_charts(events: Sequence[Row]) -> list[Chart]:
    """Return charts of PSNR, loss and the number of Gaussians, each over iterations and over seconds.

    Args:
        events: Rows of ``events.jsonl``. Where a resumed run repeats an iteration, the later row counts.

    Returns:
        The charts, those over iterations first; without rows to draw, none.
    """
    charts = []
    for x_key, x_label in (("iteration", "iteration"), ("seconds", "training time")):
        for chart in _CHARTS:
            series = [
                (source, _subsample(training_values(events, source.kind, source.key, x_key)))
                for source in chart.series
            ]
            series = [(source, values) for source, values in series if values]
            if series:
                charts.append(_layout_chart(chart, x_key, x_label, series))
    return charts


def training_values(
    events: Sequence[Row], kind: str, key: str, x_key: str = "seconds"
) -> list[tuple[float, float]]:
    """Return one value of a training over time, from its event rows.

    Args:
        events: Rows of ``events.jsonl``. Where a resumed run repeats an iteration, the later row counts.
        kind: ``training_progress`` or ``held_out_measured``.
        key: Of the value.
        x_key: ``iteration`` or ``seconds``.

    Returns:
        Pairs of finite numbers, one per iteration, in order of iteration.
    """
    latest: dict[float, tuple[float, float]] = {}
    for row in events:
        if row.get("kind") != kind:
            continue
        numbers = [row.get("iteration"), row.get(x_key), row.get(key)]
        if all(isinstance(n, int | float) and math.isfinite(n) for n in numbers):
            iteration, x, y = (float(n) for n in numbers)  # type: ignore[arg-type]
            latest[iteration] = (x, y)
    return [latest[iteration] for iteration in sorted(latest)]


def format_axis_duration(seconds: float) -> str:
    """Format a duration for an axis: ``8.2 s``, ``4 min 10 s``, ``2 h 05 min``.

    >>> format_axis_duration(8.2), format_axis_duration(250), format_axis_duration(7500)
    ('8.2 s', '4 min 10 s', '2 h 05 min')
    """
    if seconds < 60:
        return f"{seconds:.1f} s" if 0 < seconds < 10 else f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s" if rest else f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes % 60 else f"{minutes // 60} h"


def format_axis_number(value: float) -> str:
    """Format a number for an axis: ``1500`` as ``1.5 k``, ``2000000`` as ``2 M``.

    >>> format_axis_number(0.25), format_axis_number(1500), format_axis_number(2_000_000)
    ('0.25', '1.5 k', '2 M')
    """
    for size, suffix in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if abs(value) >= size:
            return f"{value / size:.4g}{suffix}"
    return f"{value:.4g}"


def _subsample(values: list[tuple[float, float]]) -> list[tuple[float, float]]:
    step = max(1, math.ceil(len(values) / MAX_POINTS))
    # The last value always stays, as the end of the curve.
    return values[::step] + ([values[-1]] if values and (len(values) - 1) % step else [])


def _layout_chart(
    chart: _ChartSource,
    x_key: str,
    x_label: str,
    series: list[tuple[_SeriesSource, list[tuple[float, float]]]],
) -> Chart:
    """Return a chart's axes, ticks and lines in SVG units; ``series`` has at least one point."""
    # One value without a logarithm makes the whole axis linear.
    logarithmic = chart.logarithmic and all(y > 0 for _, values in series for _, y in values)
    if logarithmic:
        series = [(source, [(x, math.log10(y)) for x, y in values]) for source, values in series]
    xs = [x for _, values in series for x, _ in values]
    ys = [y for _, values in series for _, y in values]
    x_low, x_high = _padded_range(min(0.0, *xs), max(xs))  # training begins at 0
    y_low, y_high = _padded_range(min(ys), max(ys))
    if chart.y_from_zero:
        y_low = 0.0
    # Lines keep clear of the frame, except from an axis that begins at exactly 0.
    margin = 0.05 * (y_high - y_low)
    y_low, y_high = (y_low if y_low == 0.0 else y_low - margin), y_high + margin

    def to_svg_x(x: float) -> float:
        return round(LEFT + (x - x_low) / (x_high - x_low) * (WIDTH - LEFT - RIGHT), 2)

    def to_svg_y(y: float) -> float:
        return round(HEIGHT - BOTTOM - (y - y_low) / (y_high - y_low) * (HEIGHT - TOP - BOTTOM), 2)

    if x_key == "seconds":
        x_ticks = [Tick(to_svg_x(x), format_axis_duration(x)) for x in _time_ticks(x_low, x_high)]
    else:
        x_ticks = [Tick(to_svg_x(x), format_axis_number(x)) for x in _linear_ticks(x_low, x_high, 5)]
    if logarithmic:
        y_ticks = [Tick(to_svg_y(y), f"{10**y:.2g}") for y in _log_ticks(y_low, y_high)]
    else:
        y_ticks = [Tick(to_svg_y(y), format_axis_number(y)) for y in _linear_ticks(y_low, y_high, 5)]
    curves = tuple(
        Curve(source.label, source.style, tuple((to_svg_x(x), to_svg_y(y)) for x, y in values))
        for source, values in series
    )
    return Chart(
        title=chart.title,
        x_key=x_key,
        x_label=x_label,
        unit=chart.unit,
        x_range=(x_low, x_high),
        y_range=(y_low, y_high),
        logarithmic=logarithmic,
        x_ticks=tuple(x_ticks),
        y_ticks=tuple(y_ticks),
        curves=curves,
    )


def _padded_range(low: float, high: float) -> tuple[float, float]:
    """Return the range widened where it is empty, so that a single value can be drawn."""
    if high > low:
        return low, high
    half = abs(low) * 0.1 or 1.0
    return low - half, high + half


def _linear_ticks(low: float, high: float, about: int) -> list[float]:
    """Return round numbers within a range, ``about`` of them."""
    raw = (high - low) / about
    power = 10.0 ** math.floor(math.log10(raw))
    # Rounding must not pass over a step that fits exactly.
    step = next(power * f for f in (1, 2, 2.5, 5, 10) if power * f >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def _time_ticks(low_seconds: float, high_seconds: float) -> list[float]:
    """Return whole seconds, minutes or hours within a range; linear ticks for very short or long ranges."""
    round_steps = (1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200, 14400, 28800, 86400)
    length = high_seconds - low_seconds
    step = next((step for step in round_steps if length / step <= MAX_TIME_INTERVALS), None)
    if step is None or length < MIN_TIME_RANGE_SECONDS:
        return _linear_ticks(low_seconds, high_seconds, 4)
    first, last = math.ceil(low_seconds / step), math.floor(high_seconds / step)
    return [float(k * step) for k in range(first, last + 1)]


def _log_ticks(low: float, high: float) -> list[float]:
    """Return logarithms of 1, 2 and 5 times powers of ten within a range; fewer where it is wide."""
    factors = (1,) if high - low > 2.5 else (1, 2, 5) if high - low > 0.5 else (1, 1.5, 2, 3, 4, 5, 6, 8)
    powers = range(math.floor(low), math.ceil(high) + 1)
    steps = [power + math.log10(factor) for power in powers for factor in factors]
    inside = [step for step in steps if low <= step <= high]
    return inside if len(inside) > 1 else [low, high]
